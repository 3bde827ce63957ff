"""One look at a frame: arc, stripe and joint within a reach about an expected seam."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.map import CELL, ArcMap
from noise_model.arc.scene import Scene, scene_along
from noise_model.arrays import Integers
from noise_model.median import known_median
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from tracker import checks, flags
from tracker.arc.level import UNKNOWN, ArcLevel
from tracker.arc.transmission import NO_LIGHT, Transmission
from tracker.checks import Asked, ask_whether, take_answer
from tracker.geometry import SEARCH_REACH_MM, TRACK_REACH_MM, SensorGeometry
from tracker.joint import MeasuredJoint, fit_closed_joint, fit_section
from tracker.joint.ask import ask_joint
from tracker.joint.evidence import MIN_EVIDENCE_NATS
from tracker.joint.image_line import read_image_line
from tracker.joint.measured import undetermined
from tracker.joint.section import Section
from tracker.joint.type_check import is_another_type
from tracker.look import (
    MIN_HELD_SHARE,
    ArcSeen,
    FrameLight,
    Look,
    ask_light,
    level_of,
    look_at,
    no_stripe,
    nothing_read,
    output_for,
    read_look,
    see_arc,
)
from tracker.profile import Profile
from tracker.seam.locate import locate
from tracker.state import Frame, Pose, Stripe
from tracker.stripe.band import LightLevel
from tracker.stripe.expected import ExpectedStripe, expect_stripe
from tracker.stripe.read import LitBand, Work, light_band
from tracker.stripe.scatter import NO_SCATTER, Scatter
from tracker.stripe.smooth import smoothed


class Reading(NamedTuple):
    """What one look at a frame, within a reach about an expected seam, has found.

    `scatter` is what the frames up to this one show of the stripe, `read_with` what the look was taken with.
    """

    asked: Asked
    scene: Scene
    seam: SeamLine
    reach_mm: float
    arc: ArcLevel = UNKNOWN
    stripe: Stripe | None = None
    joint: MeasuredJoint | None = None
    fov_margin_mm: float = math.nan
    scatter: Scatter = NO_SCATTER
    read_with: Scatter = NO_SCATTER

    @property
    def flags(self) -> int:
        """The flags that the look raises; of a frame that was tracked in one call, those of the frame."""
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
    look = _look(asked, geometry, frame, scene, seam.as_floats(), reach_mm, work, use_arc_map, scatter)
    stripe = look.stripe if look.stripe.position_px.size else None
    if not look.is_stripe:
        return Reading(asked, scene, seam, reach_mm, look.arc, stripe, scatter=scatter, read_with=scatter)
    joint, margin_mm = _joint(asked, geometry, scene, frame, look, reach_mm)
    return Reading(asked, scene, seam, reach_mm, look.arc, stripe, joint, margin_mm, look.scatter, scatter)


def _look(
    asked: Asked,
    geometry: SensorGeometry,
    frame: Frame,
    scene: Scene,
    seam: SeamLine,
    reach_mm: float,
    work: Work,
    use_arc_map: bool,
    scatter: Scatter,
) -> Look:
    """Take a look, by its pieces where effects act on the arc's light on its way to the pixels."""
    image_dn, light, source = frame.image_dn, frame_light(geometry.setup, frame), geometry.look_source
    if not geometry.has_light_effects:
        whole: Look = look_at(
            asked, source, scene, seam, reach_mm, image_dn, light, work, use_arc_map, scatter
        )
        return whole
    none = no_stripe(geometry.along_rows)
    if not ask_whether(asked, checks.CAMERA_ABOVE, not scene.below_surface):
        return nothing_read(UNKNOWN, none, scatter)
    expected = expect_stripe(geometry, scene)
    ask_whether(asked, checks.STRIPE_EXPECTED, expected is not None)
    if expected is None:
        return nothing_read(UNKNOWN, none, scatter)
    reach_px = geometry.reach_px(reach_mm)
    seen = see_arc(source, scene, expected, image_dn, light, reach_px)
    transmission = transmission_of(geometry, scene, seen, frame)
    arc_e, other_e = (seen.arc_e, NO_LIGHT)
    if transmission is not None:
        arc_e, other_e = transmission.through(seen.pixels, seen.arc_e)
    arc = level_of(source, seen, arc_e, other_e, light)
    if not ask_light(asked, arc, light):
        return nothing_read(arc, none, scatter)
    lit = light_through(geometry, seen, transmission, arc, image_dn, expected, reach_px, work, use_arc_map)
    return read_look(asked, source, scene, seam, reach_mm, expected, arc, lit, work, scatter)


def transmission_of(
    geometry: SensorGeometry, scene: Scene, seen: ArcSeen, frame: Frame
) -> Transmission | None:
    """Return what a frame's effects make of the arc's light, None if no effect acts on it."""
    arc_map = ArcMap(seen.kernel, geometry.xy, geometry.cos4, seen.table)
    output = expected_output(geometry.setup, frame) if shows_arc(geometry.setup, frame) else 0.0
    return Transmission.of(geometry, scene, arc_map.at, output)


def light_through(
    geometry: SensorGeometry,
    seen: ArcSeen,
    transmission: Transmission | None,
    arc: ArcLevel,
    image_dn: Integers,
    expected: ExpectedStripe,
    reach_px: float,
    work: Work,
    use_arc_map: bool,
) -> LitBand:
    """Return `light_band`'s band with its light as it comes through effects."""
    has_effects = transmission is not None
    lit: LitBand = light_band(
        geometry.look_source,
        seen.kernel,
        seen.table,
        arc,
        image_dn,
        expected,
        reach_px,
        work,
        use_arc_map,
        has_effects,
    )
    if transmission is None or not use_arc_map:
        return lit
    band = lit.band
    n_scan, depth = band.background.shape
    first = np.arange(n_scan) * geometry.n_pos + band.lows[np.arange(n_scan) // CELL]
    pixels = (first[:, None] + np.arange(depth)).ravel()
    arc_e, other_e = transmission.through(pixels, band.background.ravel())
    band.background[:] = (np.float32(lit.light.level) * arc_e + other_e).reshape(n_scan, depth)
    return lit._replace(light=LightLevel(1.0, lit.light.black_e))


def _joint(
    asked: Asked,
    geometry: SensorGeometry,
    scene: Scene,
    frame: Frame,
    look: Look,
    reach_mm: float,
) -> tuple[MeasuredJoint | None, float]:
    """Return the joint that a stripe shows, and its margin in the view, mm, NaN where none is told."""
    profile = profile_of(look.section, frame, geometry.along_rows)
    joint = fit_section(look.section, geometry.setup.joint, frame.image_dn, geometry.along_rows)
    if geometry.setup.joint.type == "butt" and not _is_told(joint):
        closed = _closed_joint(geometry, scene, look, profile)
        if _is_told(closed):
            ask_whether(asked, checks.GAP_SHOWN, False)
            joint = closed
    # A narrower look shows only what lies where the stated joint should.
    if reach_mm == SEARCH_REACH_MM:
        ask_whether(asked, checks.JOINT_TYPE, not is_another_type(profile, geometry.setup.joint, joint))
    nothing = undetermined()
    counted, margin_mm = ask_joint(asked, nothing if joint is None else joint, profile.y_mm)
    return (counted if counted.is_determined else None), margin_mm


def _is_told(joint: MeasuredJoint | None) -> bool:
    """Say whether a joint is told from a plate."""
    return joint is not None and joint.evidence_nats >= MIN_EVIDENCE_NATS


def _closed_joint(
    geometry: SensorGeometry, scene: Scene, look: Look, profile: Profile
) -> MeasuredJoint | None:
    """Return the closed joint whose line the image shows beside the stripe, None where it shows none."""
    stripe_sigma_px = known_median(look.section.light.width_px)
    line = read_image_line(geometry, scene, smoothed(look.stripe).position_px, stripe_sigma_px, profile)
    return None if line is None else fit_closed_joint(profile, geometry.setup.joint, line)


def profile_of(section: Section, frame: Frame, along_rows: bool) -> Profile:
    """Return a section as a profile, with the whole frame by scan line."""
    points = section.points
    return Profile(
        points.y_mm,
        points.z_mm,
        points.dy_mm,
        points.dz_mm,
        points.sigma_px,
        points.scan,
        section.column_mm,
        points.beside_px,
        reach_mm=section.reach_mm,
        light=section.light,
        image_dn=frame.image_dn.T if along_rows else frame.image_dn,
        mixed_mm=section.mixed_mm,
        bias_px=section.bias_px,
        misfit_px=points.misfit_px,
        slope_sigma=section.slope_sigma,
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
    # A first frame's scatter is known from the look before.
    known = scatter if scatter.frames > 0 else placed.scatter
    again = measure(geometry, frame, pose, there, TRACK_REACH_MM, work, use_arc_map, known)
    # What only a wrong map shows is no stripe: most of its lines are gone with the right one.
    if again.joint is None and _lines_held(again) >= MIN_HELD_SHARE * _lines_held(placed):
        return first
    # The narrow look does not see as far beside the stripe.
    take_answer(again.asked, placed.asked, checks.JOINT_TYPE)
    if placed.flags & flags.TWO_STRIPES.mask:
        take_answer(again.asked, placed.asked, checks.SECOND_STRIPE)
    return again._replace(scatter=again.scatter._replace(frames=scatter.frames + 1))


def as_stated(reading: Reading) -> Reading:
    """Return a search's reading without its joint where that is neither of its shape nor of its type.

    Of pieces of two stripes, or of one that the map has broken, a section can be made that no plate explains.
    A seam that is read off its line in the image does not stand on the section.
    """
    both = flags.JOINT_TYPE_MISMATCH.mask | flags.JOINT_MISFIT.mask
    said = reading.flags & (both | flags.SEAM_BY_LINE.mask)
    if reading.joint is None:
        return reading
    is_stated = ask_whether(reading.asked, checks.JOINT_AS_STATED, said != both)
    return reading if is_stated else reading._replace(joint=None)


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
    arc, exposure_s = setup.arc, setup.camera.exposure_s
    output: float = output_for(
        float(frame.current_a), float(frame.exposure_s), arc.current_a, exposure_s, arc.current_exponent
    )
    return output


def frame_light(setup: Setup, frame: Frame) -> FrameLight:
    """Return what is said to light a frame."""
    return FrameLight(
        float(frame.exposure_s), float(frame.current_a), bool(frame.laser_on), bool(shows_arc(setup, frame))
    )
