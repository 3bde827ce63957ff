"""One look at a frame: arc, stripe and joint within a reach about an expected seam."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.map import arc_kernel
from noise_model.arc.scene import Scene, scene_along
from noise_model.arc_source import level as current_level
from noise_model.median import known_median
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from tracker import checks, flags
from tracker.arc.level import (
    UNKNOWN,
    ArcLevel,
    estimate_ambient_light,
    estimate_arc_level,
    unlit_by_the_laser,
)
from tracker.arc.transmission import Transmission
from tracker.checks import Asked, ask, ask_whether, take_answer
from tracker.geometry import SEARCH_REACH_MM, SensorGeometry
from tracker.joint import HIDING_TYPES, MeasuredJoint, fit_closed_joint, fit_joint
from tracker.joint.evidence import MIN_EVIDENCE_NATS
from tracker.joint.image_line import read_image_line
from tracker.joint.type_check import is_another_type
from tracker.profile import Profile, StripeLines, measured_points
from tracker.seam.locate import locate, sources
from tracker.state import Frame, Pose, Stripe
from tracker.stripe.band import FIT_SIGMAS
from tracker.stripe.detection import (
    MIN_RATIO,
    MIN_SEEN,
    seen_share,
)
from tracker.stripe.expected import ExpectedStripe, expect_stripe
from tracker.stripe.read import StripeReading, Work, arc_map_of, read_stripe
from tracker.stripe.scatter import NO_SCATTER, Scatter

TRACK_REACH_MM = 1.0
"""How far from its expected place it is looked for once it is known, beyond three sigmas of that place."""

MIN_HELD_SHARE, WHOLE_SHARE = 0.2, 0.75
"""The share of the scan lines that the joint crosses which must hold a stripe, and below it is partial."""

MIN_TOLD_NATS = math.log(1e2)
"""Of two stripes the laser's must be told by so much: its reflection is read once in a hundred at most."""

ARC_OFF_SIGMAS = 5.0
MISFIT_LIMIT = 2.0
JOINT_CHI2_LIMIT = 9.0
UNEXPLAINED_LIMIT = 0.1
"""So large a share of the points near the seam may lie off the joint's shape: spatter, a tack weld's end."""

MIN_MARGIN_MM = 1.0
"""A seam nearer to the profile's end than this is out of view."""

BEYOND_REACH_MM = 1.0
"""So much farther than a stripe is followed its joint is looked for."""

MAX_CURRENT_A, MAX_EXPOSURE_S = 1e4, 1e2
"""No welding current and no exposure reaches these: such a number is not known."""


class Reading(NamedTuple):
    """What one look at a frame, within a reach about an expected seam, has found."""

    asked: Asked
    scene: Scene
    seam: SeamLine
    reach_mm: float
    arc: ArcLevel = UNKNOWN
    stripe: Stripe | None = None
    joint: MeasuredJoint | None = None
    fov_margin_mm: float = math.nan
    scatter: Scatter = NO_SCATTER

    @property
    def flags(self) -> int:
        """The flags that the look raises."""
        return self.asked.flags


def measure(
    geometry: SensorGeometry,
    frame: Frame,
    pose: Pose,
    seam: SeamLine,
    reach_mm: float,
    work: Work,
    use_arc_map: bool,
    scatter: Scatter,
) -> Reading:
    """Look for arc, stripe and joint about a seam; `scatter` is what earlier frames show of the stripe's."""
    scene = scene_along(geometry.seam_source.scene, pose.T_base_tool, seam)
    asked = Asked.nothing()
    if not ask_whether(asked, checks.CAMERA_ABOVE, not scene.below_surface):
        return Reading(asked, scene, seam, reach_mm, scatter=scatter)
    expected = expect_stripe(geometry, scene)
    ask_whether(asked, checks.STRIPE_EXPECTED, expected is not None)
    if expected is None:
        return Reading(asked, scene, seam, reach_mm, scatter=scatter)
    reach_px = geometry.reach_px(reach_mm)
    output = expected_output(geometry.setup, frame)
    kernel = arc_kernel(geometry.setup, scene, output)
    keep_off = reach_px + FIT_SIGMAS * expected.widest_px
    stripe_px = expected.position_px if frame.laser_on else None
    arc_map = arc_map_of(geometry, kernel)
    is_arc_on = shows_arc(geometry.setup, frame)
    transmission = Transmission.of(geometry, scene, arc_map.at, output if is_arc_on else 0.0)
    unlit = unlit_by_the_laser(geometry, arc_map.at, transmission, frame.image_dn, stripe_px, keep_off)
    arc = (estimate_arc_level if is_arc_on else estimate_ambient_light)(geometry, unlit)
    _ask_arc(asked, arc)
    if not ask_whether(asked, checks.LASER_ON, frame.laser_on):
        return Reading(asked, scene, seam, reach_mm, arc, scatter=scatter)

    look = read_stripe(
        geometry,
        arc_map,
        transmission,
        arc,
        frame,
        expected,
        reach_px,
        work,
        use_arc_map,
        scatter,
        reach_mm >= SEARCH_REACH_MM,
    )
    # An arc lights rims that end as a fan does.
    seeks_ends = geometry.setup.laser.fan_half_angle_deg is None and not arc.is_on
    if not _is_stripe(asked, expected, look, seeks_ends):
        return Reading(asked, scene, seam, reach_mm, arc, look.stripe, scatter=scatter)
    joint, margin_mm = _joint(asked, geometry, scene, seam, frame, expected, look, reach_mm)
    return Reading(asked, scene, seam, reach_mm, arc, look.stripe, joint, margin_mm, look.scatter)


def _joint(
    asked: Asked,
    geometry: SensorGeometry,
    scene: Scene,
    seam: SeamLine,
    frame: Frame,
    expected: ExpectedStripe,
    look: StripeReading,
    reach_mm: float,
) -> tuple[MeasuredJoint | None, float]:
    """Return the joint that a stripe shows, and its margin in the view, mm, NaN where none is told."""
    profile = profile_of(geometry, scene, frame, expected, look, reach_mm, seam.slope_sigma)
    joint = joint_of(geometry, scene, seam.station_mm, profile)
    if geometry.setup.joint.type == "butt" and not _is_told(joint):
        closed = _closed_joint(geometry, scene, look, profile)
        if _is_told(closed):
            ask_whether(asked, checks.GAP_SHOWN, False)
            joint = closed
    # A narrower look shows only what lies where the stated joint should.
    if reach_mm == SEARCH_REACH_MM:
        ask_whether(asked, checks.JOINT_TYPE, not is_another_type(profile, geometry.setup.joint, joint))
    ask_whether(asked, checks.JOINT_SEEN, joint is not None)
    if joint is None or not ask(asked, checks.JOINT_EVIDENCE, joint.evidence_nats, MIN_EVIDENCE_NATS):
        return None, math.nan
    margin_mm = min(joint.y_mm - float(profile.y_mm[0]), float(profile.y_mm[-1]) - joint.y_mm)
    if not ask(asked, checks.VIEW_MARGIN, margin_mm, MIN_MARGIN_MM):
        return None, margin_mm
    ask(asked, checks.JOINT_CHI2, joint.chi2, JOINT_CHI2_LIMIT)
    ask(asked, checks.JOINT_UNEXPLAINED, joint.unexplained, UNEXPLAINED_LIMIT)
    return joint, margin_mm


def joint_of(
    geometry: SensorGeometry, scene: Scene, station_mm: float, profile: Profile
) -> MeasuredJoint | None:
    """Return the joint that a profile at a station shows, None where it does not determine one."""
    joint = geometry.setup.joint
    hides = joint.type in HIDING_TYPES
    return fit_joint(profile, joint, *(sources(geometry.seam_source, scene, station_mm) if hides else ()))


def _is_told(joint: MeasuredJoint | None) -> bool:
    """Say whether a joint is told from a plate."""
    return joint is not None and joint.evidence_nats >= MIN_EVIDENCE_NATS


def _closed_joint(
    geometry: SensorGeometry, scene: Scene, look: StripeReading, profile: Profile
) -> MeasuredJoint | None:
    """Return the closed joint whose line the image shows beside the stripe, None where it shows none."""
    stripe_sigma_px = known_median(look.width_px)
    line = read_image_line(geometry, scene, look.stripe.smooth_px, stripe_sigma_px, profile)
    return None if line is None else fit_closed_joint(profile, geometry.setup.joint, line)


def _is_stripe(
    asked: Asked,
    expected: ExpectedStripe,
    look: StripeReading,
    seeks_ends: bool,
) -> bool:
    """Ask whether what was read is a stripe, and whether all of it was seen, up to ends that it may show."""
    stripe, told = look.stripe, look.evidence
    share = told.share
    ask(asked, checks.LINES_SATURATED, float(told.n_saturated), 0.0)
    ask_whether(asked, checks.STRIPE_INSIDE, not told.leaves)
    if not ask(asked, checks.LINES_HELD, share, MIN_HELD_SHARE):
        return False
    if not ask(asked, checks.STRIPE_EVIDENCE, told.ratio, MIN_RATIO):
        return False
    if share < WHOLE_SHARE:
        band = look.band
        seen = seen_share(
            expected,
            stripe.position_px,
            stripe.amplitude_e,
            band.variance,
            band.censored,
            seeks_ends,
        )
        if not ask(asked, checks.CLEAR_LINES_HELD, seen, MIN_SEEN):
            return False
    ask(asked, checks.STRIPE_WHOLE, share, WHOLE_SHARE)
    # Of what is no stripe nothing is the second.
    ask(asked, checks.SECOND_STRIPE, look.second_share, 0.0)
    return not math.isfinite(look.told_nats) or ask(asked, checks.STRIPE_TOLD, look.told_nats, MIN_TOLD_NATS)


def profile_of(
    geometry: SensorGeometry,
    scene: Scene,
    frame: Frame,
    expected: ExpectedStripe,
    look: StripeReading,
    reach_mm: float,
    slope_sigma: float,
) -> Profile:
    """Return a stripe's profile, whose seam is looked for within the look's reach and a little beyond."""
    stripe, source = look.stripe, geometry.stripe_source
    points = measured_points(
        source,
        scene,
        StripeLines(
            stripe.position_px,
            stripe.sigma_px,
            stripe.beside_px,
            stripe.amplitude_e,
            look.width_px,
            expected.bias_px,
            look.misfit_px,
            look.n_lines,
        ),
        look.usual.contrast,
        geometry.seam_source.height_mm,
        slope_sigma,
    )
    return Profile(
        points.y_mm,
        points.z_mm,
        points.dy_mm,
        points.dz_mm,
        points.sigma_px,
        points.scan,
        points.column_mm,
        points.beside_px,
        reach_mm=reach_mm + BEYOND_REACH_MM,
        light=look.light(source.psf_sigma_px, points.sheet_lines),
        image_dn=frame.image_dn.T if geometry.along_rows else frame.image_dn,
        mixed_mm=points.mixed_mm,
        bias_px=points.bias_px,
        misfit_px=points.misfit_px,
        slope_sigma=slope_sigma,
        n_lines=points.n_lines,
    )


def measure_again(
    geometry: SensorGeometry,
    frame: Frame,
    pose: Pose,
    nominal_scene: Scene,
    seam: SeamLine,
    first: Reading,
    work: Work,
    use_arc_map: bool,
    scatter: Scatter,
) -> Reading:
    """Look again where a search has found the joint: the map for another place misleads, near its edges most.

    If the map misled the search itself, the joint is placed without it. If the second look holds hardly any
    stripe, there was none.
    """
    placed = first
    if first.joint is None and first.stripe is not None and use_arc_map:
        placed = measure(geometry, frame, pose, seam, SEARCH_REACH_MM, work, False, scatter)
    if placed.joint is None:
        return first
    joint = placed.joint
    located = locate(geometry.seam_source, nominal_scene.T_joint_tool, placed.scene, joint.y_mm, joint.z_mm)
    y_mm, z_mm = located.displacement_mm
    there = seam._replace(station_mm=located.station_mm, y_mm=y_mm, z_mm=z_mm)
    again = measure(geometry, frame, pose, there, TRACK_REACH_MM, work, use_arc_map, scatter)
    # What only a wrong map shows is no stripe: most of its lines are gone with the right one.
    if again.joint is None and _lines_held(again) >= MIN_HELD_SHARE * _lines_held(placed):
        return first
    # The narrow look does not see as far beside the stripe.
    take_answer(again.asked, placed.asked, checks.JOINT_TYPE)
    if placed.flags & flags.TWO_STRIPES.mask:
        take_answer(again.asked, placed.asked, checks.SECOND_STRIPE)
    return again


def _lines_held(reading: Reading) -> int:
    """Return how many scan lines hold a stripe."""
    return 0 if reading.stripe is None else int(np.isfinite(reading.stripe.position_px).sum())


def shows_arc(setup: Setup, frame: Frame) -> bool:
    """Say whether a frame is said to show an arc that the setup knows."""
    return frame.arc_on and setup.arc.shines


def expected_output(setup: Setup, frame: Frame) -> float:
    """Return what the setup expects of the arc for a frame's current and exposure, over the nominal output.

    Without a known current, or with the arc said to be off, that is the nominal one, and so is an exposure.
    """
    nominal_s = setup.camera.exposure_s
    current = current_level(setup.arc, frame.current_a) if 0.0 < frame.current_a < MAX_CURRENT_A else 1.0
    exposure = frame.exposure_s / nominal_s if 0.0 < frame.exposure_s < MAX_EXPOSURE_S else 1.0
    return current * exposure


def _ask_arc(asked: Asked, arc: ArcLevel) -> None:
    """Ask whether there is arc light, and whether the map explains it."""
    if not ask_whether(asked, checks.ARC_ON, arc.is_on):
        return
    if not ask_whether(asked, checks.ARC_LEVEL_KNOWN, arc is not UNKNOWN):
        return
    if ask(asked, checks.ARC_LEVEL, arc.level, ARC_OFF_SIGMAS * arc.sigma):
        ask(asked, checks.MAP_MISFIT, arc.misfit, MISFIT_LIMIT)
