"""A frame tracked in one compiled call: from image and pose to the new state and the track.

There is one such call for each shape of joint: what joins its pieces is compiled too. A search looks more
than once, and asks in Python what type of joint it sees: it takes the same pieces by itself (`tracker.step`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
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
from tracker.joint.evidence import MIN_EVIDENCE_NATS
from tracker.joint.fillet import fit_fillet
from tracker.joint.groove import fit_groove
from tracker.joint.half_v import fit_half_v
from tracker.joint.lap import fit_lap
from tracker.joint.measured import MeasuredJoint, undetermined
from tracker.joint.slot import fit_slot
from tracker.look import FrameLight, Look, look_at, no_stripe, nothing_read
from tracker.seam.correction import CorrectionNumbers
from tracker.seam.expected import ExpectedSeam, expect_seam, pose_checks
from tracker.seam.gaussian_process import no_history
from tracker.seam.judge import NO_SEAM, SeamShown, judge
from tracker.seam.steer import NO_OFFSET, Lead, TorchOffset
from tracker.state import Stripe
from tracker.stripe.read import Work
from tracker.tracker_state import (
    LOST_TO_FORGET,
    LOST_TO_SEARCH,
    TrackerState,
    state_after,
    stretches_of,
)

REFUSED, BY_PIECES, TRACKED = 0, 1, 2
"""How a frame ends here: its pose shows no seam, it is left to `tracker.step`'s pieces, or it is tracked."""


class FrameGiven(NamedTuple):
    """What a frame is tracked with: what the setup fixes, the state, the frame and its pose.

    `T_base_tool` (4, 4) is the tool's pose, mm, `image_dn` (H, W) the raw frame. The `work` is scratch.
    """

    source: LookSource
    stated: StatedJoint
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


class Begun(NamedTuple):
    """A frame up to its joint: how it ends, what was expected, the scene along the seam, and the look."""

    ends: int
    expected: ExpectedSeam
    reach_mm: float
    scene: Scene
    look: Look


class FrameTracked(NamedTuple):
    """What a frame gives: how it ends, the state after it, the seam, the offset, and the look they rest on.

    `joint` is undetermined where none counts. Of a frame that is not TRACKED nothing else holds.
    """

    ends: int
    state: TrackerState
    shown: SeamShown
    offset: TorchOffset
    scene: Scene
    seam: SeamLine
    reach_mm: float
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
def begin(asked: Asked, given: FrameGiven) -> Begun:
    """Track a frame up to its joint."""
    source, state, scatter = given.source, given.state, given.state.scatter
    ask_whether(asked, checks.FRAME_FORMAT, True)
    ask_whether(asked, checks.POSE_KNOWN, True)
    ask_whether(asked, checks.POSE_BRACKETED, not given.is_extrapolated)
    expected = expect(source, state, given.T_base_tool)
    reach_mm = reach_of(state, expected)
    can_look = pose_checks(asked, source.seam, expected.pose)
    if not can_look or reach_mm >= SEARCH_REACH_MM:
        nothing = nothing_read(UNKNOWN, no_stripe(source.image.along_rows), scatter)
        return Begun(BY_PIECES if can_look else REFUSED, expected, reach_mm, expected.scene, nothing)
    ask(asked, checks.REACH, reach_mm, SEARCH_REACH_MM)
    line = expected.line
    scene = laid_scene(source.seam.scene, given.T_base_tool, line, line, True)
    look = look_at(
        asked,
        source,
        scene,
        line,
        reach_mm,
        given.image_dn,
        given.light,
        given.work,
        given.use_arc_map,
        scatter,
    )
    return Begun(TRACKED, expected, reach_mm, scene, look)


@kernel(allocates=True)
def end(asked: Asked, given: FrameGiven, begun: Begun, fitted: MeasuredJoint) -> FrameTracked:
    """Judge the joint that was fitted to a frame's section, and steer by it."""
    look, state, joint, margin_mm = begun.look, given.state, fitted, math.nan
    after, shown, offset = state, NO_SEAM, NO_OFFSET
    if begun.ends == TRACKED:
        if look.is_stripe:
            joint, margin_mm = ask_joint(asked, fitted, look.section.points.y_mm)
        judged = judge(
            asked,
            given.source.seam,
            given.correction,
            stretches_of(state),
            state.steering,
            state.frames + 1,
            begun.expected,
            begun.scene,
            (joint.y_mm, joint.z_mm),
            (joint.covariance_mm2[0, 0], joint.covariance_mm2[1, 1]),
            look.stripe.position_px.shape[0] > 0,
            given.timestamp_s,
            given.lead,
        )
        after = state_after(state, judged.stretches, judged.steering, look.scatter)
        shown, offset = judged.shown, judged.offset
    return FrameTracked(
        begun.ends,
        after,
        shown,
        offset,
        begun.scene,
        begun.expected.line,
        begun.reach_mm,
        look.arc,
        look.stripe,
        joint,
        margin_mm,
    )


@kernel(allocates=True)
def track_groove(asked: Asked, given: FrameGiven) -> FrameTracked:
    """Track a frame of a groove with a bevel on either side."""
    begun, joint = begin(asked, given), undetermined()
    if begun.look.is_stripe:
        joint = fit_groove(begun.look.section, given.stated)
    return end(asked, given, begun, joint)


@kernel(allocates=True)
def track_lap(asked: Asked, given: FrameGiven) -> FrameTracked:
    """Track a frame of a lap, plain or corrugated."""
    begun, joint = begin(asked, given), undetermined()
    if begun.look.is_stripe:
        joint = fit_lap(begun.look.section, given.stated)
    return end(asked, given, begun, joint)


@kernel(allocates=True)
def track_half_v(asked: Asked, given: FrameGiven) -> FrameTracked:
    """Track a frame of a half V."""
    begun, joint = begin(asked, given), undetermined()
    if begun.look.is_stripe:
        joint = fit_half_v(begun.look.section, given.stated)
    return end(asked, given, begun, joint)


@kernel(allocates=True)
def track_fillet(asked: Asked, given: FrameGiven) -> FrameTracked:
    """Track a frame of a fillet."""
    begun, joint = begin(asked, given), undetermined()
    if begun.look.is_stripe:
        joint = fit_fillet(begun.look.section, given.stated)
    return end(asked, given, begun, joint)


@kernel(allocates=True)
def track_slot(asked: Asked, given: FrameGiven) -> FrameTracked:
    """Track a frame of a butt or an edge joint.

    Of a butt joint whose gap is not told the image may show a line: that is read by pieces.
    """
    begun, joint = begin(asked, given), undetermined()
    if begun.look.is_stripe:
        along_rows = given.source.image.along_rows
        joint = fit_slot(begun.look.section, given.stated, given.image_dn, along_rows)
        if not given.stated.is_edge and not joint.evidence_nats >= MIN_EVIDENCE_NATS:
            begun = Begun(BY_PIECES, begun.expected, begun.reach_mm, begun.scene, begun.look)
    return end(asked, given, begun, joint)


TRACKS: Mapping[str, Callable[[Asked, FrameGiven], FrameTracked]] = {
    "v_groove": track_groove,
    "u_groove": track_groove,
    "half_v": track_half_v,
    "fillet": track_fillet,
    "butt": track_slot,
    "edge": track_slot,
    "lap": track_lap,
    "corrugation": track_lap,
}
"""What tracks a frame of a type of joint in one call."""
