"""Observation of a frame about an expected seam: the arc's light, the stripe and its section."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from noise_model import arc_source
from noise_model.arc.map import CELL, arc_kernel, horizon_of
from noise_model.arc.scene import Scene
from noise_model.compiled.arrays import Float32, Float64, Int64
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from tracker import checks
from tracker.arc.burning import NO_EVIDENCE, ArcEvidence, arc_evidence
from tracker.arc.level import (
    NOWHERE,
    UNKNOWN,
    ArcLevel,
    estimate_ambient_light,
    estimate_arc_level,
    off_stripe,
    only_seen,
)
from tracker.arc.prediction import ArcLightBuffers, predict_arc
from tracker.arc.transmission import NO_LIGHT, Transmission
from tracker.checks import FrameChecks
from tracker.geometry import SEARCH_REACH_MM, SensorGeometry, dark_variance_at
from tracker.joint.measured import MeasuredJoint
from tracker.joint.plate_lines import StripeImage
from tracker.profile import EdgeAlongSeam, Points, Section, triangulate
from tracker.seam.correction import Correction
from tracker.seam.locate import sources, straightened
from tracker.state import Frame, OffsetLookAhead, Stripe
from tracker.stripe.band import FIT_SIGMAS, Band, LightLevel, gather_band
from tracker.stripe.detection import MIN_RATIO, MIN_SEEN, seen_share
from tracker.stripe.expected import ExpectedStripe, expect_stripe
from tracker.stripe.light import StripeLight
from tracker.stripe.read import (
    LitBand,
    StripeReading,
    Work,
    arc_map_of,
    light_of,
    over_arc_map,
    over_median,
    read_stripe,
)
from tracker.stripe.scatter import NO_SCATTER, Scatter
from tracker.tracker_state import TrackerMemory

MIN_HELD_SHARE, WHOLE_SHARE = 0.2, 0.75
"""The share of the scan lines that the joint crosses which must hold a stripe, and below it is partial."""

MIN_CHOICE_NATS = math.log(1e2)
"""Least evidence that separates the laser's of two stripes: its reflection is read once in a hundred at most.
"""

ARC_OFF_SIGMAS = 5.0
MISFIT_LIMIT = 2.0

NO_PIXELS, NO_BAND = np.empty(0, np.int64), np.empty((0, 0), np.float32)

MAX_CURRENT_A, MAX_EXPOSURE_S = 1e4, 1e2
"""No welding current and no exposure reaches these: such a number is not known."""


class FrameInput(NamedTuple):
    """Inputs of a frame's tracking: the setup's tables, the state before it, the frame and its pose.

    `T_base_tool` (4, 4) is the tool's pose, mm; `work` is scratch. `arc_burns` as the frame was told: it is
    read without an arc too, and with one that its picture alone shows.
    """

    geometry: SensorGeometry
    state: TrackerMemory
    frame: Frame
    T_base_tool: Float64
    is_extrapolated: bool
    work: Work
    use_arc_map: bool
    correction: Correction
    lead: OffsetLookAhead
    arc_burns: bool

    @property
    def stripe_image(self) -> StripeImage:
        """The frame's codes, as a joint's fit takes them."""
        geometry = self.geometry
        return StripeImage(self.frame.image_dn, geometry.along_rows, geometry.saturation_dn)


class Aim(NamedTuple):
    """Expected seam of an observation, and the half-width of the search about it.

    `scatter` is that of the stripe in the frames before.
    """

    scene: Scene
    seam: SeamLine
    reach_mm: float
    use_arc_map: bool
    scatter: Scatter


class Observation(NamedTuple):
    """Result of one observation of a frame; None where it did not get that far.

    `arc` is the light other than the laser's, `evidence` that an arc burns, `stripe` what was read of the
    stripe, `section` the profile of a stripe that counts. What is in `stripe` beyond the stripe itself is
    valid until the next observation.
    """

    arc: ArcLevel = UNKNOWN
    evidence: ArcEvidence = NO_EVIDENCE
    expected: ExpectedStripe | None = None
    transmission: Transmission | None = None
    stripe: StripeReading | None = None
    section: Section | None = None


class Reading(NamedTuple):
    """Result of the observation that counts of a frame, within a reach about an expected seam.

    `scatter` is that of the stripe up to this frame, `read_with` the one that was used.
    """

    checks: FrameChecks
    scene: Scene
    seam: SeamLine
    reach_mm: float
    arc: ArcLevel = UNKNOWN
    evidence: ArcEvidence = NO_EVIDENCE
    stripe: Stripe | None = None
    joint: MeasuredJoint | None = None
    fov_margin_mm: float = math.nan
    scatter: Scatter = NO_SCATTER
    read_with: Scatter = NO_SCATTER

    @property
    def flags(self) -> int:
        """The flags that its frame raises."""
        return self.checks.flags

    def aim(self, use_arc_map: bool) -> Aim:
        """Return the aim of the look."""
        return Aim(self.scene, self.seam, self.reach_mm, use_arc_map, self.read_with)

    @property
    def n_held(self) -> int:
        """The number of scan lines that hold a stripe."""
        return 0 if self.stripe is None else int(np.isfinite(self.stripe.position_px).sum())


def observe(given: FrameInput, frame_checks: FrameChecks, aim: Aim) -> Observation:
    """Look for arc, stripe and section about a seam."""
    geometry, frame, scene = given.geometry, given.frame, aim.scene
    if not frame_checks.ask_whether(checks.CAMERA_ABOVE, not scene.below_surface):
        return Observation()
    expected = expect_stripe(geometry, scene)
    frame_checks.ask_whether(checks.STRIPE_EXPECTED, expected is not None)
    if expected is None:
        return Observation()
    reach_px = geometry.reach_px(aim.reach_mm)
    half_px = reach_px + FIT_SIGMAS * expected.widest_px
    stripe_px, band = NOWHERE, None
    if frame.laser_on:
        stripe_px, room = expected.position_px, given.work.pixels
        band = gather_band(frame.image_dn, geometry.image_source, stripe_px, math.ceil(half_px), room)
    pixels, charge_e = off_stripe(geometry.image_source, frame.image_dn, stripe_px, half_px)
    seen = _observe_light(given, aim, pixels, charge_e, band)
    if seen.evidence.burns and not given.arc_burns:
        burning = given._replace(frame=replace(frame, arc_on=True))
        seen = _observe_light(burning, aim, pixels, charge_e, band)
    seen, arc = seen._replace(expected=expected), seen.arc
    if not _check_light(frame_checks, arc, band is not None) or band is None:
        return seen
    lit = _lit_band(geometry, aim, seen, band)
    reading = read_stripe(
        geometry.image_source,
        geometry.stripe_source.psf_sigma_px,
        lit=lit,
        expected=expected,
        reach_px=reach_px,
        room=given.work.room,
        scatter=aim.scatter,
        is_searching=aim.reach_mm >= SEARCH_REACH_MM,
    )
    seen = seen._replace(stripe=reading)
    # An arc lights rims that end as a fan does.
    seeks_ends = geometry.setup.laser.fan_half_angle_deg is None and not arc.is_on
    if not _check_stripe(frame_checks, expected, reading, seeks_ends):
        return seen
    return seen._replace(section=observed_section(geometry, aim, seen))


def _observe_light(
    given: FrameInput, aim: Aim, pixels: Int64, charge_e: Float64, band: Band | None
) -> Observation:
    """Return a frame's light apart from the laser's, by pixels (n,) off the stripe that hold `charge_e`."""
    image, setup = given.geometry.image_source, given.geometry.setup
    arc_e, other_e, transmission = predict_light(given, aim, pixels, band)
    unlit = only_seen(arc_e, charge_e, other_e, pixels)
    shown = estimate_arc_level(image, unlit) if setup.arc.shines else UNKNOWN
    arc = shown if shows_arc(setup, given.frame) else estimate_ambient_light(image, unlit)
    hall_e = given.state.arc.hall_e * exposure_ratio(setup, given.frame)
    return Observation(arc, arc_evidence(image, unlit, shown, hall_e), transmission=transmission)


def observed_section(geometry: SensorGeometry, aim: Aim, seen: Observation) -> Section:
    """Return the section of a stripe, whose joint is searched a little beyond an observation's reach."""
    assert seen.stripe is not None
    reading, source, seam_source = seen.stripe, geometry.stripe_source, geometry.seam_source
    edge = EdgeAlongSeam(seam_source.height_mm, aim.seam.slope_sigma, reading.usual.contrast)
    seen_points = triangulate(source, aim.scene, reading.lines, edge)
    return section_of(geometry, aim, seen_points, light_of(reading, source.psf_sigma_px, seen_points.edge))


def section_of(geometry: SensorGeometry, aim: Aim, seen_points: Points, light: StripeLight) -> Section:
    """Return the section of triangulated points along a seam that may turn."""
    seam_source, (points, column_mm, _, mixed_lines) = geometry.seam_source, seen_points
    points = straightened(seam_source, aim.scene, aim.seam.station_mm, aim.reach_mm, points)
    camera_mm, laser_mm = sources(seam_source, aim.scene, aim.seam.station_mm)
    # Additional half-width of the search for the joint over that for the stripe.
    return Section(
        points=points,
        column_mm=column_mm,
        reach_mm=aim.reach_mm + 1.0,
        mixed_mm=column_mm * mixed_lines,
        slope_sigma=aim.seam.slope_sigma,
        light=light,
        camera_mm=camera_mm,
        laser_mm=laser_mm,
    )


def _check_light(frame_checks: FrameChecks, arc: ArcLevel, laser_on: bool) -> bool:
    """Test whether there is arc light and the map explains it; return True if the laser is on."""
    if (
        frame_checks.ask_whether(checks.ARC_ON, arc.is_on)
        and frame_checks.ask_whether(checks.ARC_LEVEL_KNOWN, not math.isnan(arc.level))
        and frame_checks.ask(checks.ARC_LEVEL, arc.level, ARC_OFF_SIGMAS * arc.sigma)
    ):
        frame_checks.ask(checks.MAP_MISFIT, arc.misfit, MISFIT_LIMIT)
    return frame_checks.ask_whether(checks.LASER_ON, laser_on)


def _check_stripe(
    frame_checks: FrameChecks, expected: ExpectedStripe, reading: StripeReading, seeks_ends: bool
) -> bool:
    """Return True if what was read is a stripe; test whether all of it was seen, up to ends it may show."""
    evidence, ask = reading.evidence, frame_checks.ask
    ask(checks.LINES_SATURATED, float(evidence.n_saturated), 0.0)
    frame_checks.ask_whether(checks.STRIPE_INSIDE, not evidence.leaves)
    if not ask(checks.LINES_HELD, evidence.share, MIN_HELD_SHARE):
        return False
    if not ask(checks.STRIPE_EVIDENCE, evidence.ratio, MIN_RATIO):
        return False
    if evidence.share < WHOLE_SHARE:
        seen = seen_share(
            expected=expected,
            position_px=reading.stripe.position_px,
            amplitude_e=reading.stripe.amplitude_e,
            background_e=reading.band.background,
            shot=reading.noise.shot,
            dark_variance_e2=reading.noise.dark_e2,
            censored=reading.band.censored,
            seeks_ends=seeks_ends,
        )
        if not ask(checks.CLEAR_LINES_HELD, seen, MIN_SEEN):
            return False
    ask(checks.STRIPE_WHOLE, evidence.share, WHOLE_SHARE)
    # Of what is no stripe nothing is the second.
    ask(checks.SECOND_STRIPE, reading.second_share, 0.0)
    return not math.isfinite(reading.stripe_choice_nats) or ask(
        checks.STRIPE_CHOICE, reading.stripe_choice_nats, MIN_CHOICE_NATS
    )


def predict_light(
    given: FrameInput, aim: Aim, pixels: Int64, band: Band | None
) -> tuple[Float32, Float32, Transmission | None]:
    """Write the arc's light at its expected output to a band's background, and return it at pixels (n,), e-.

    With it comes what effects make there of other light, and what they do to the light; None if none acts.
    """
    geometry = given.geometry
    output = expected_output(geometry.setup, given.frame)
    has_arc = shows_arc(geometry.setup, given.frame)
    lows, band_e, arc_e = NO_PIXELS, NO_BAND, np.empty(len(pixels), np.float32)
    if band is not None and aim.use_arc_map and (has_arc or geometry.has_light_effects):
        lows, band_e = band.lows, band.background
    material, into = (
        geometry.stripe_source.material,
        ArcLightBuffers(pixels, arc_e, lows, band_e, given.work.arc),
    )
    source, horizon = geometry.arc_source, horizon_of(aim.scene, geometry.arc_source.radius_mm)
    predict_arc(source, geometry.image_source, material, aim.scene, horizon, output, into)
    transmission = transmission_of(geometry, aim.scene, given.frame)
    if transmission is None:
        return arc_e, NO_LIGHT, None
    return (*transmission.through(pixels, arc_e), transmission)


def transmission_of(geometry: SensorGeometry, scene: Scene, frame: Frame) -> Transmission | None:
    """Return the transmission of the arc's light through a frame's effects, None if no effect acts on it."""
    if not geometry.has_light_effects:
        return None
    output = expected_output(geometry.setup, frame)
    arc_map = arc_map_of(geometry, arc_kernel(geometry.setup, scene, output))
    stated = output if shows_arc(geometry.setup, frame) else 0.0
    return Transmission.of(geometry, scene, arc_map.at, stated)


def _lit_band(geometry: SensorGeometry, aim: Aim, seen: Observation, band: Band) -> LitBand:
    """Return a band with what lights it, as that comes through effects."""
    arc, image, transmission = seen.arc, geometry.image_source, seen.transmission
    dark_e2 = dark_variance_at(image, band.charge)
    base_sigma_e = math.hypot(image.black_sigma_e, arc.ambient_e)
    if not aim.use_arc_map:
        return over_median(band, dark_e2, base_sigma_e)
    lit = over_arc_map(band, arc, dark_e2, base_sigma_e, geometry.setup.tolerance.arc_level_rel)
    if transmission is None:
        if arc.level == 0.0:
            band.background[:] = 0.0
        return lit
    n_scan, depth = band.background.shape
    first = np.arange(n_scan) * geometry.n_pos + band.lows[np.arange(n_scan) // CELL]
    pixels = (first[:, None] + np.arange(depth)).ravel()
    arc_e, other_e = transmission.through(pixels, band.background.ravel())
    band.background[:] = (np.float32(lit.light.level) * arc_e + other_e).reshape(n_scan, depth)
    return lit._replace(light=LightLevel(1.0, lit.light.black_e))


def shows_arc(setup: Setup, frame: Frame) -> bool:
    """Return True if a frame is said to show an arc that the setup knows."""
    return frame.arc_on and setup.arc.shines


def expected_output(setup: Setup, frame: Frame) -> float:
    """Return the arc's expected output for a frame's current and exposure, over the nominal one.

    Without a known current, or with the arc said to be off, that is the nominal one, and so is an exposure.
    """
    current_a = float(frame.current_a)
    output = arc_source.level(setup.arc, current_a) if 0.0 < current_a < MAX_CURRENT_A else 1.0
    return output * exposure_ratio(setup, frame)


def exposure_ratio(setup: Setup, frame: Frame) -> float:
    """Return a frame's exposure over the nominal one, 1 where it is not known."""
    exposure_s = float(frame.exposure_s)
    return exposure_s / setup.camera.exposure_s if 0.0 < exposure_s < MAX_EXPOSURE_S else 1.0
