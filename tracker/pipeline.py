"""A frame's way from image and pose to the track: expect, look, fit, judge, steer.

This is the one order of the stages. Live runs, replays and explanations go through it; what works on pixels
and points is a kernel, what decides is here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from noise_model.arc.scene import laid_scene
from noise_model.compiled.median import known_median
from noise_model.surface.joint import SeamLine
from tracker import checks, flags
from tracker.checks import FrameChecks
from tracker.geometry import SEARCH_REACH_MM, TRACK_REACH_MM
from tracker.joint import MeasuredJoint, fit_closed_joint, fit_section
from tracker.joint.evidence import MIN_EVIDENCE_NATS
from tracker.joint.image_line import read_image_line
from tracker.joint.type_check import shows_another
from tracker.judge import SeamEstimate, judge
from tracker.observation import MIN_HELD_SHARE, Aim, FrameInput, Observation, Reading, observe
from tracker.profile import Section
from tracker.profile_observation import ProfileObservation, observe_profile
from tracker.seam.expected import ExpectedSeam, check_pose, expect_seam, ground_at_torch, pose_numbers
from tracker.seam.gaussian_process import NO_HISTORY
from tracker.seam.locate import locate
from tracker.steer import TorchOffset, steer
from tracker.stripe.scatter import Scatter
from tracker.stripe.smooth import smoothed
from tracker.tracker_state import LOST_TO_FORGET, LOST_TO_SEARCH, TrackerMemory

JOINT_CHI2_LIMIT = 9.0
MAX_COVERED_MM = 0.8
"""An edge that another surface covers farther is not seen: its 1 sigma would be half a millimetre."""


class FrameResult(NamedTuple):
    """Result of a frame: the state after it, the observation that counts, seam and offset at the torch."""

    state: TrackerMemory
    reading: Reading
    shown: SeamEstimate | None
    offset: TorchOffset


def track_frame(given: FrameInput, frame_checks: FrameChecks) -> FrameResult | None:
    """Track a frame; return None where its pose shows no seam."""
    state, source = given.state, given.geometry.seam_source
    frame_checks.ask_whether(checks.FRAME_FORMAT, True)
    frame_checks.ask_whether(checks.POSE_KNOWN, True)
    frame_checks.ask_whether(checks.POSE_BRACKETED, not given.is_extrapolated)
    if not check_pose(frame_checks, source, pose_numbers(source, given.T_base_tool)):
        return None
    # After LOST_TO_FORGET frames without a joint the earlier ones count no longer.
    confirmed = state.history if state.lost < LOST_TO_FORGET else NO_HISTORY
    expected = expect_seam(source, given.T_base_tool, confirmed)
    reach_mm = min(SEARCH_REACH_MM, TRACK_REACH_MM + 3.0 * max(expected.sigma_mm))
    if state.lost >= LOST_TO_SEARCH:
        reach_mm = SEARCH_REACH_MM
    aim = _aim_at(given, expected, expected.segment, expected.line, reach_mm, state.scatter)
    if frame_checks.ask(checks.REACH, reach_mm, SEARCH_REACH_MM):
        reading = look_and_fit(given, frame_checks, aim)
    else:
        reading = search(given, frame_checks, aim, expected)
    after, shown = judge(frame_checks, given, expected, reading)
    steering, offset = steer(frame_checks, given, expected, after, shown is not None)
    after = after._replace(steering=steering, scatter=reading.scatter, frames=state.frames + 1)
    return FrameResult(after, reading, shown, offset)


def search(given: FrameInput, frame_checks: FrameChecks, aim: Aim, expected: ExpectedSeam) -> Reading:
    """Look widely for the joint, then look where it is.

    The map for another place misleads, near its edges most. So a search looks again where it has found the
    joint. If the map misled the search itself, the joint is placed without it.
    """
    wide = placed = look_and_fit(given, FrameChecks(), aim)
    if wide.joint is None and wide.stripe is not None and given.use_arc_map:
        placed = look_and_fit(given, FrameChecks(), aim._replace(use_arc_map=False))
    reading = wide
    if placed.joint is not None:
        at_joint = look_and_fit(given, FrameChecks(), _aim_at_joint(given, expected, aim, placed))
        reading = _nearer_look(given, wide, placed, at_joint)
    reading = as_stated(reading)
    frame_checks.extend(reading.checks)
    return reading._replace(checks=frame_checks)


def look_and_fit(given: FrameInput, frame_checks: FrameChecks, aim: Aim) -> Reading:
    """Look at a frame about a seam, and fit the joint to the section that it shows."""
    is_image = given.geometry.setup.profiler is None
    seen = observe(given, frame_checks, aim) if is_image else observe_profile(given, frame_checks, aim)
    joint, margin_mm = None, math.nan
    if seen.section is not None:
        joint, margin_mm = _fit_joint(given, frame_checks, aim, seen)
    # What is no stripe says nothing of the scatter.
    counted = None if seen.section is None else seen.stripe
    return Reading(
        checks=frame_checks,
        scene=aim.scene,
        seam=aim.seam,
        reach_mm=aim.reach_mm,
        arc=seen.arc,
        evidence=seen.evidence,
        stripe=None if seen.stripe is None else seen.stripe.stripe,
        joint=joint,
        fov_margin_mm=margin_mm,
        scatter=aim.scatter if counted is None else counted.scatter,
        read_with=aim.scatter,
    )


def _aim_at(
    given: FrameInput, expected: ExpectedSeam, segment: int, seam: SeamLine, reach_mm: float, scatter: Scatter
) -> Aim:
    """Return the aim of a look at a seam, relative to a segment of the nominal line."""
    source = given.geometry.seam_source
    ground = ground_at_torch(source, expected, segment, seam)
    scene = laid_scene(
        source.scene, given.T_base_tool, segment, seam, seam if ground is None else ground, ground is None
    )
    return Aim(scene, seam, reach_mm, given.use_arc_map, scatter)


def _aim_at_joint(given: FrameInput, expected: ExpectedSeam, aim: Aim, placed: Reading) -> Aim:
    """Return the aim of the look at the joint that a wide look has placed."""
    assert placed.joint is not None
    source = given.geometry.seam_source
    located = locate(source, given.T_base_tool, placed.scene, placed.joint.y_mm, placed.joint.z_mm)
    seam, scatter = aim.seam, given.state.scatter
    before, here = (
        source.lean(expected.segment, seam.station_mm),
        source.lean(located.segment, located.station_mm),
    )
    slopes = seam.slope_y + here[0] - before[0], seam.slope_z + here[1] - before[1]
    there = SeamLine(located.station_mm, *located.displacement_mm, *slopes, seam.slope_sigma)
    # A first frame's scatter is known from the look before.
    scatter = scatter if scatter.frames > 0 else placed.scatter
    return _aim_at(given, expected, located.segment, there, TRACK_REACH_MM, scatter)


def _nearer_look(given: FrameInput, wide: Reading, placed: Reading, at_joint: Reading) -> Reading:
    """Return the look that counts of those that placed the joint and looked at it.

    What only a wrong map shows is no stripe: most of its lines are gone with the right one. Then the look at
    the joint counts, else one that shows no joint does not.
    """
    if at_joint.joint is None and at_joint.n_held >= MIN_HELD_SHARE * placed.n_held:
        return wide
    # The narrow search does not reach as far from the stripe.
    at_joint.checks.take_answer(placed.checks, checks.JOINT_TYPE)
    if placed.flags & flags.TWO_STRIPES.mask:
        at_joint.checks.take_answer(placed.checks, checks.SECOND_STRIPE)
    # It is the same frame's second look.
    return at_joint._replace(scatter=Scatter(at_joint.scatter.average, given.state.scatter.frames + 1))


def as_stated(reading: Reading) -> Reading:
    """Return a search's result without its joint where that is neither of its shape nor of its type.

    Of pieces of two stripes, or of one that the map has broken, a section can be made that no plate explains.
    A seam that is read off its line in the image does not stand on the section.
    """
    if reading.joint is None:
        return reading
    unlikely = flags.JOINT_TYPE_MISMATCH.mask | flags.JOINT_MISFIT.mask
    is_stated = reading.flags & (unlikely | flags.SEAM_BY_LINE.mask) != unlikely
    if reading.checks.ask_whether(checks.JOINT_AS_STATED, is_stated):
        return reading
    return reading._replace(joint=None)


def _fit_joint(
    given: FrameInput, frame_checks: FrameChecks, aim: Aim, seen: Observation | ProfileObservation
) -> tuple[MeasuredJoint | None, float]:
    """Return the joint that a section shows, None where none counts, and its margin in the view, mm."""
    section, geometry = seen.section, given.geometry
    assert section is not None
    stated = geometry.setup.joint
    joint = fit_section(section, stated, given.stripe_image)
    if stated.type == "butt" and isinstance(seen, Observation) and not _is_distinct(joint):
        closed = _closed_joint(given, aim, seen)
        if _is_distinct(closed):
            frame_checks.ask_whether(checks.GAP_SHOWN, False)
            joint = closed
    # A narrower look shows only what lies where the stated joint should.
    if aim.reach_mm == SEARCH_REACH_MM:
        frame_checks.ask_whether(checks.JOINT_TYPE, not shows_another(section, stated, joint))
    return check_joint(frame_checks, joint, section)


def _is_distinct(joint: MeasuredJoint | None) -> bool:
    """Return True if a joint is distinguishable from a flat plate."""
    return joint is not None and joint.evidence_nats >= MIN_EVIDENCE_NATS


def _closed_joint(given: FrameInput, aim: Aim, seen: Observation) -> MeasuredJoint | None:
    """Return the closed joint whose line the image shows next to the stripe, None where it shows none."""
    geometry, section = given.geometry, seen.section
    assert section is not None
    assert seen.stripe is not None
    image_dn = given.frame.image_dn.T if geometry.along_rows else given.frame.image_dn
    stripe_px = smoothed(seen.stripe.stripe).position_px
    stripe_sigma_px = known_median(section.light.width_px)
    burns = given.arc_burns or bool(seen.evidence.burns)
    line = read_image_line(geometry, aim.scene, stripe_px, stripe_sigma_px, section, image_dn, burns)
    return None if line is None else fit_closed_joint(section, geometry.setup.joint, line)


def check_joint(
    frame_checks: FrameChecks, joint: MeasuredJoint | None, section: Section
) -> tuple[MeasuredJoint | None, float]:
    """Return a section's joint, None if it does not count, and its margin in the view, mm, NaN for none."""
    frame_checks.ask_whether(checks.JOINT_SEEN, joint is not None)
    if joint is None or not frame_checks.ask(checks.JOINT_EVIDENCE, joint.evidence_nats, MIN_EVIDENCE_NATS):
        return None, math.nan
    margin_mm = float(min(joint.y_mm - section.y_mm[0], section.y_mm[-1] - joint.y_mm))
    # A seam nearer to the profile's end than this is out of view.
    if not frame_checks.ask(checks.VIEW_MARGIN, margin_mm, 1.0):
        return None, margin_mm
    frame_checks.ask(checks.JOINT_CHI2, joint.chi2, JOINT_CHI2_LIMIT)
    frame_checks.ask(checks.JOINT_UNEXPLAINED, joint.misfit_nats, MIN_EVIDENCE_NATS)
    if not frame_checks.ask(checks.EDGE_SHOWN, joint.covered_mm, MAX_COVERED_MM):
        return None, margin_mm
    return joint, margin_mm
