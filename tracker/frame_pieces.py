"""The pieces of a frame's step: what is expected, the look, the joint that it shows, and what follows of it.

`tracker.frame` joins them in one compiled call for each shape of joint, `tracker.step` where Python comes in
between.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from noise_model.arc.scene import Scene, laid_scene
from noise_model.arrays import Float64, Integers
from noise_model.kernel import kernel
from noise_model.surface.joint import SeamLine
from noise_model.surface.stated_joint import StatedJoint
from tracker import checks
from tracker.arc.level import UNKNOWN, ArcLevel
from tracker.checks import Asked, ask, ask_whether
from tracker.geometry import SEARCH_REACH_MM, TRACK_REACH_MM, LookSource
from tracker.joint.ask import ask_joint
from tracker.joint.measured import MeasuredJoint, undetermined
from tracker.joint.type_check import shows_another
from tracker.look import FrameLight, Look, look_at, no_stripe
from tracker.seam.correction import CorrectionNumbers
from tracker.seam.expected import ExpectedSeam, expect_seam, pose_checks
from tracker.seam.gaussian_process import no_history
from tracker.seam.judge import NO_SEAM, SeamShown, judge
from tracker.seam.steer import NO_OFFSET, Lead, TorchOffset
from tracker.state import Stripe
from tracker.stripe.read import Work
from tracker.stripe.scatter import Scatter
from tracker.tracker_state import (
    LOST_TO_FORGET,
    LOST_TO_SEARCH,
    TrackerState,
    state_after,
    stretches_of,
)

REFUSED, BY_PIECES, SEARCHED, TRACKED = 0, 1, 2, 3
"""What becomes of a frame: its pose shows no seam, one compiled call does not serve it, its seam is searched,
or it is tracked."""


class FrameGiven(NamedTuple):
    """What a frame is tracked with: what the setup fixes, the state, the frame and its pose.

    `family` is the number of the stated joint's family, see `joint.type_check`. `T_base_tool` (4, 4) is the
    tool's pose, mm, `image_dn` (H, W) the raw frame. The `work` is scratch.
    """

    source: LookSource
    stated: StatedJoint
    family: int
    correction: CorrectionNumbers
    state: TrackerState
    image_dn: Integers
    light: FrameLight
    T_base_tool: Float64
    is_extrapolated: bool
    timestamp_s: float
    lead: Lead
    work: Work
    use_arc_map: bool


class Aim(NamedTuple):
    """Where a look is taken, how far about the seam there, and with what is known of the stripe's scatter."""

    scene: Scene
    seam: SeamLine
    reach_mm: float
    use_arc_map: bool
    scatter: Scatter


class Begun(NamedTuple):
    """A frame before its first look: what becomes of it, what is expected, and where the look is taken."""

    ends: int
    expected: ExpectedSeam
    aim: Aim


class Seen(NamedTuple):
    """What a look shows; `joint` is undetermined where none counts.

    `scatter` is what the frames so far show of the stripe's, and `margin_mm` is by how much the joint lies
    within the view, NaN where none is told.
    """

    asked: Asked
    aim: Aim
    arc: ArcLevel
    stripe: Stripe
    scatter: Scatter
    joint: MeasuredJoint
    margin_mm: float


class FrameTracked(NamedTuple):
    """What a frame gives: what became of it, the state after it, the seam, the offset and the look.

    Of a frame that is not TRACKED nothing else holds.
    """

    ends: int
    state: TrackerState
    shown: SeamShown
    offset: TorchOffset
    aim: Aim
    arc: ArcLevel
    stripe: Stripe
    joint: MeasuredJoint
    fov_margin_mm: float


@kernel
def reach_of(state: TrackerState, expected: ExpectedSeam) -> float:
    """Return how far about the expected seam it is looked for, mm."""
    if state.lost >= LOST_TO_SEARCH:
        return SEARCH_REACH_MM
    sigma_y_mm, sigma_z_mm = expected.sigma_mm
    return min(SEARCH_REACH_MM, TRACK_REACH_MM + 3.0 * max(sigma_y_mm, sigma_z_mm))


@kernel(allocates=True)
def expect(source: LookSource, state: TrackerState, T_base_tool: Float64) -> ExpectedSeam:
    """Return what a pose and the earlier frames let a step expect.

    After LOST_TO_FORGET frames without a joint they say nothing any more.
    """
    confirmed = state.history if state.lost < LOST_TO_FORGET else no_history()
    return expect_seam(source.seam, T_base_tool, confirmed)


@kernel(allocates=True)
def aim_at(given: FrameGiven, seam: SeamLine, reach_mm: float, use_arc_map: bool, scatter: Scatter) -> Aim:
    """Return the aim of a look at a seam."""
    scene = laid_scene(given.source.seam.scene, given.T_base_tool, seam, seam, True)
    return Aim(scene, seam, reach_mm, use_arc_map, scatter)


@kernel(allocates=True)
def begin(asked: Asked, given: FrameGiven) -> Begun:
    """Ask what can be asked of a frame before it is looked at, and say where that is done."""
    source, state = given.source, given.state
    ask_whether(asked, checks.FRAME_FORMAT, True)
    ask_whether(asked, checks.POSE_KNOWN, True)
    ask_whether(asked, checks.POSE_BRACKETED, not given.is_extrapolated)
    expected = expect(source, state, given.T_base_tool)
    reach_mm = reach_of(state, expected)
    if not pose_checks(asked, source.seam, expected.pose):
        nowhere = Aim(expected.scene, expected.line, reach_mm, given.use_arc_map, state.scatter)
        return Begun(REFUSED, expected, nowhere)
    is_near = ask(asked, checks.REACH, reach_mm, SEARCH_REACH_MM)
    aim = aim_at(given, expected.line, reach_mm, given.use_arc_map, state.scatter)
    return Begun(TRACKED if is_near else SEARCHED, expected, aim)


@kernel(allocates=True)
def look_by(asked: Asked, given: FrameGiven, aim: Aim) -> Look:
    """Take a look on whose light no effects act."""
    return look_at(
        asked,
        given.source,
        aim.scene,
        aim.seam,
        aim.reach_mm,
        given.image_dn,
        given.light,
        given.work,
        aim.use_arc_map,
        aim.scatter,
    )


@kernel(allocates=True)
def seen_by(asked: Asked, given: FrameGiven, aim: Aim, look: Look, fitted: MeasuredJoint) -> Seen:
    """Return what a look shows, whose section the joint was fitted to."""
    joint, margin_mm = fitted, math.nan
    if look.is_stripe:
        # A narrower look shows only what lies where the stated joint should.
        if aim.reach_mm == SEARCH_REACH_MM:
            points, column_mm = look.section.points, look.section.column_mm
            is_other = shows_another(points, column_mm, given.family, given.stated, fitted)
            ask_whether(asked, checks.JOINT_TYPE, not is_other)
        joint, margin_mm = ask_joint(asked, fitted, look.section.points.y_mm)
    return Seen(asked, aim, look.arc, look.stripe, look.scatter, joint, margin_mm)


@kernel(allocates=True)
def nothing_seen(asked: Asked, given: FrameGiven, begun: Begun) -> Seen:
    """Return what a frame shows that was not looked at."""
    stripe = no_stripe(given.source.image.along_rows)
    return Seen(asked, begun.aim, UNKNOWN, stripe, given.state.scatter, undetermined(), math.nan)


@kernel(allocates=True)
def end(asked: Asked, given: FrameGiven, begun: Begun, seen: Seen) -> FrameTracked:
    """Judge the joint that a frame shows, and steer by it."""
    state, joint = given.state, seen.joint
    judged = judge(
        asked,
        given.source.seam,
        given.correction,
        stretches_of(state),
        state.steering,
        state.frames + 1,
        begun.expected,
        seen.aim.scene,
        (joint.y_mm, joint.z_mm),
        (joint.covariance_mm2[0, 0], joint.covariance_mm2[1, 1]),
        seen.stripe.position_px.shape[0] > 0,
        given.timestamp_s,
        given.lead,
    )
    after = state_after(state, judged.stretches, judged.steering, seen.scatter)
    return FrameTracked(
        TRACKED,
        after,
        judged.shown,
        judged.offset,
        seen.aim,
        seen.arc,
        seen.stripe,
        joint,
        seen.margin_mm,
    )


@kernel(allocates=True)
def not_tracked(asked: Asked, given: FrameGiven, begun: Begun, ends: int) -> FrameTracked:
    """Return what a frame gives that is not tracked."""
    seen = nothing_seen(asked, given, begun)
    return FrameTracked(
        ends,
        given.state,
        NO_SEAM,
        NO_OFFSET,
        seen.aim,
        seen.arc,
        seen.stripe,
        seen.joint,
        seen.margin_mm,
    )
