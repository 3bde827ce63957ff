"""One look at a frame about an expected seam, compiled: arc, stripe and the section that the stripe shows.

Effects of a setup act on the arc's light in Python. So a look is made of pieces between which they can act;
`look_at` takes it in one call where none do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.fill import fill_pixels
from noise_model.arc.map import NODES_P, NODES_Q, ArcKernel, kernel_of, table_of
from noise_model.arc.scene import Scene
from noise_model.arc.table import FaceTable
from noise_model.arrays import Float32, Float64, Int64, Integers
from noise_model.kernel import kernel
from noise_model.surface.joint import SeamLine
from tracker import checks
from tracker.arc.level import (
    UNKNOWN,
    ArcLevel,
    estimate_ambient_light,
    estimate_arc_level,
    off_stripe,
    only_seen,
)
from tracker.checks import Asked, ask, ask_whether
from tracker.geometry import MAP_FLOOR_E, MAP_TOLERANCE, SEARCH_REACH_MM, LookSource
from tracker.joint.measured import SectionPoints
from tracker.joint.section import Section
from tracker.profile import StripeLines, measured_points
from tracker.seam.locate import sources
from tracker.state import Stripe
from tracker.stripe.band import FIT_SIGMAS
from tracker.stripe.detection import MIN_RATIO, MIN_SEEN, seen_share
from tracker.stripe.expected import ExpectedStripe, expect
from tracker.stripe.light import no_light
from tracker.stripe.read import LitBand, StripeReading, Work, light_band, light_of, read_stripe
from tracker.stripe.scatter import Scatter

MIN_HELD_SHARE, WHOLE_SHARE = 0.2, 0.75
"""The share of the scan lines that the joint crosses which must hold a stripe, and below it is partial."""

MIN_TOLD_NATS = math.log(1e2)
"""Of two stripes the laser's must be told by so much: its reflection is read once in a hundred at most."""

ARC_OFF_SIGMAS = 5.0
MISFIT_LIMIT = 2.0

BEYOND_REACH_MM = 1.0
"""So much farther than a stripe is followed its joint is looked for."""

MAX_CURRENT_A, MAX_EXPOSURE_S = 1e4, 1e2
"""No welding current and no exposure reaches these: such a number is not known."""


class FrameLight(NamedTuple):
    """What is said to light a frame, see `state.Frame`; `has_arc` says that an arc is on and is stated."""

    exposure_s: float
    current_a: float
    laser_on: bool
    has_arc: bool


class ArcSeen(NamedTuple):
    """The arc's map for a pose, and its light at its expected output, (n,) e-, off the stripe.

    `pixels` (n,) are counted by scan line, `charge_e` (n,) is what they hold.
    """

    kernel: ArcKernel
    table: FaceTable
    pixels: Int64
    charge_e: Float64
    arc_e: Float32


class Look(NamedTuple):
    """What a look shows: arc, stripe and the section of a joint that the stripe runs over.

    `stripe` is empty where none was read, and `section` where what was read is none: then `is_stripe` is
    False. `scatter` is what the frames so far show of the stripe's.
    """

    arc: ArcLevel
    is_stripe: bool
    stripe: Stripe
    scatter: Scatter
    section: Section


@kernel
def output_for(
    current_a: float, exposure_s: float, stated_a: float, stated_s: float, exponent: float
) -> float:
    """Return what is expected of the arc for a current and an exposure, over the output that is stated.

    Without a known current, or with the arc said to be off, that is the stated one, and so is an exposure.
    """
    current, exposure = 1.0, 1.0
    if 0.0 < current_a < MAX_CURRENT_A:
        current = (current_a / stated_a) ** exponent
    if 0.0 < exposure_s < MAX_EXPOSURE_S:
        exposure = exposure_s / stated_s
    return float(current * exposure)


@kernel(allocates=True)
def see_arc(
    source: LookSource,
    scene: Scene,
    expected: ExpectedStripe,
    image_dn: Integers,
    light: FrameLight,
    reach_px: float,
) -> ArcSeen:
    """Predict the arc's light of a scene, and read pixels that the laser does not light."""
    arc, image = source.arc, source.image
    output = output_for(light.current_a, light.exposure_s, arc.current_a, arc.exposure_s, arc.exponent)
    k = kernel_of(
        scene,
        arc.radius_mm,
        arc.radiance_e * output,
        source.stripe.material,
        arc.rules,
        NODES_P,
        NODES_Q,
    )
    table = table_of(k, image.xy, image.n_scan, MAP_TOLERANCE, MAP_FLOOR_E, arc.to_powers, arc.baked)
    keep_off_px = reach_px + FIT_SIGMAS * expected.widest_px
    stripe_px = expected.position_px if light.laser_on else np.empty(0)
    pixels, charge_e = off_stripe(image, image_dn, stripe_px, keep_off_px)
    arc_e = np.empty(len(pixels), np.float32)
    fill_pixels(k, table, image.xy, image.cos4, pixels, arc_e)
    return ArcSeen(k, table, pixels, charge_e, arc_e)


@kernel(allocates=True)
def level_of(
    source: LookSource, seen: ArcSeen, arc_e: Float32, other_e: Float32, light: FrameLight
) -> ArcLevel:
    """Return what lights a frame beside the laser.

    `arc_e` (n,) is the arc's light at its expected output once it has passed effects, `other_e` (n,) is what
    else they make, empty for none.
    """
    unlit = only_seen(arc_e, seen.charge_e, other_e, seen.pixels)
    if light.has_arc:
        return estimate_arc_level(source.image, unlit)
    return estimate_ambient_light(source.image, unlit)


@kernel
def ask_light(asked: Asked, arc: ArcLevel, light: FrameLight) -> bool:
    """Ask whether there is arc light and the map explains it; then whether the laser is on: say that."""
    if (
        ask_whether(asked, checks.ARC_ON, arc.is_on)
        and ask_whether(asked, checks.ARC_LEVEL_KNOWN, not math.isnan(arc.level))
        and ask(asked, checks.ARC_LEVEL, arc.level, ARC_OFF_SIGMAS * arc.sigma)
    ):
        ask(asked, checks.MAP_MISFIT, arc.misfit, MISFIT_LIMIT)
    return ask_whether(asked, checks.LASER_ON, light.laser_on)


@kernel(allocates=True)
def ask_stripe(asked: Asked, expected: ExpectedStripe, reading: StripeReading, seeks_ends: bool) -> bool:
    """Ask whether what was read is a stripe, and whether all of it was seen, up to ends that it may show."""
    stripe, told = reading.stripe, reading.evidence
    ask(asked, checks.LINES_SATURATED, float(told.n_saturated), 0.0)
    ask_whether(asked, checks.STRIPE_INSIDE, not told.leaves)
    if not ask(asked, checks.LINES_HELD, told.share, MIN_HELD_SHARE):
        return False
    if not ask(asked, checks.STRIPE_EVIDENCE, told.ratio, MIN_RATIO):
        return False
    if told.share < WHOLE_SHARE:
        band = reading.band
        seen = seen_share(
            expected,
            stripe.position_px,
            stripe.amplitude_e,
            band.background,
            reading.shot,
            reading.dark_variance_e2,
            band.censored,
            seeks_ends,
        )
        if not ask(asked, checks.CLEAR_LINES_HELD, seen, MIN_SEEN):
            return False
    ask(asked, checks.STRIPE_WHOLE, told.share, WHOLE_SHARE)
    # Of what is no stripe nothing is the second.
    ask(asked, checks.SECOND_STRIPE, reading.second_share, 0.0)
    if not math.isfinite(reading.told_nats):
        return True
    return ask(asked, checks.STRIPE_TOLD, reading.told_nats, MIN_TOLD_NATS)


@kernel(allocates=True)
def section_shown(
    source: LookSource,
    scene: Scene,
    seam: SeamLine,
    expected: ExpectedStripe,
    reading: StripeReading,
    reach_mm: float,
) -> Section:
    """Return the section that a stripe shows, whose joint is looked for a little beyond a look's reach."""
    stripe = reading.stripe
    points = measured_points(
        source.stripe,
        scene,
        StripeLines(
            stripe.position_px,
            stripe.sigma_px,
            stripe.beside_px,
            stripe.amplitude_e,
            reading.width_px,
            expected.bias_px,
            reading.misfit_px,
            reading.n_lines,
        ),
        reading.usual.contrast,
        source.seam.height_mm,
        seam.slope_sigma,
    )
    camera_mm, laser_mm = sources(source.seam, scene, seam.station_mm)
    return Section(
        SectionPoints(
            points.y_mm,
            points.z_mm,
            points.dy_mm,
            points.dz_mm,
            points.scan,
            points.sigma_px,
            points.beside_px,
            points.misfit_px,
            points.n_lines,
        ),
        points.column_mm,
        reach_mm + BEYOND_REACH_MM,
        points.mixed_mm,
        seam.slope_sigma,
        points.bias_px,
        light_of(reading, source.stripe.psf_sigma_px, points.sheet_lines),
        camera_mm,
        laser_mm,
    )


@kernel(allocates=True)
def nothing_read(arc: ArcLevel, stripe: Stripe, scatter: Scatter) -> Look:
    """Return a look whose stripe, if there is any, is none."""
    none, nowhere = np.empty(0), np.full(3, math.nan)
    points = SectionPoints(none, none, none, none, none, none, none, none, none)
    section = Section(points, math.nan, 0.0, 0.0, 0.0, none, no_light(), nowhere, nowhere)
    return Look(arc, False, stripe, scatter, section)


@kernel(allocates=True)
def no_stripe(along_rows: bool) -> Stripe:
    """Return the stripe of a frame in which none was looked for."""
    none = np.empty(0)
    return Stripe(none, none, none, np.empty(0, np.bool_), along_rows, none)


@kernel(allocates=True)
def read_look(
    asked: Asked,
    source: LookSource,
    scene: Scene,
    seam: SeamLine,
    reach_mm: float,
    expected: ExpectedStripe,
    arc: ArcLevel,
    lit: LitBand,
    work: Work,
    scatter: Scatter,
) -> Look:
    """Read a band in which the stripe is looked for, within a reach about an expected seam."""
    reading = read_stripe(
        source,
        lit,
        expected,
        reach_mm * source.reach_px_per_mm,
        work.room,
        scatter,
        reach_mm >= SEARCH_REACH_MM,
    )
    # An arc lights rims that end as a fan does.
    seeks_ends = not source.states_fan and not arc.is_on
    if not ask_stripe(asked, expected, reading, seeks_ends):
        return nothing_read(arc, reading.stripe, scatter)
    section = section_shown(source, scene, seam, expected, reading, reach_mm)
    return Look(arc, True, reading.stripe, reading.scatter, section)


@kernel(allocates=True)
def look_at(
    asked: Asked,
    source: LookSource,
    scene: Scene,
    seam: SeamLine,
    reach_mm: float,
    image_dn: Integers,
    light: FrameLight,
    work: Work,
    use_arc_map: bool,
    scatter: Scatter,
) -> Look:
    """Look for arc, stripe and section about a seam; `scatter` is what earlier frames show of the stripe's.

    No effects act on the arc's light.
    """
    along_rows = source.image.along_rows
    if not ask_whether(asked, checks.CAMERA_ABOVE, not scene.below_surface):
        return nothing_read(UNKNOWN, no_stripe(along_rows), scatter)
    in_view, expected = expect(source.stripe, scene, source.image.n_scan)
    if not ask_whether(asked, checks.STRIPE_EXPECTED, in_view):
        return nothing_read(UNKNOWN, no_stripe(along_rows), scatter)
    reach_px = reach_mm * source.reach_px_per_mm
    seen = see_arc(source, scene, expected, image_dn, light, reach_px)
    arc = level_of(source, seen, seen.arc_e, np.empty(0, np.float32), light)
    if not ask_light(asked, arc, light):
        return nothing_read(arc, no_stripe(along_rows), scatter)
    lit = light_band(
        source,
        seen.kernel,
        seen.table,
        arc,
        image_dn,
        expected,
        reach_px,
        work,
        use_arc_map,
        False,
    )
    return read_look(asked, source, scene, seam, reach_mm, expected, arc, lit, work, scatter)
