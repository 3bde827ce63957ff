"""Plausibility of poses: whether they are those of a robot that moves as it says.

Each sample is compared with the ones before it (a robot has a largest speed, acceleration and rate of
turning), with what the robot says of its motion, with the programmed path, and with the nominal seam. A
sample that fails a test is doubted by name. Trust comes with `prove_s` of samples without a doubt, and after
a doubt only where the tool is again where it would be by what the robot said since: otherwise the doubt stays
until the caller begins with a new state, for a new seam.

Poses alone cannot show a drift within the limits, nor a delay or a flipped sign that moves the tool across
the seam by less than they allow. `docs/explanation/plausibility.md` says what shows those.
"""

import math
from bisect import bisect_left
from dataclasses import dataclass, replace

from robot_io.poses.nominal_path import NominalPath, Vector, minus, times
from robot_io.poses.plausibility_limits import PlausibilityLimits
from robot_io.poses.pose_questions import (
    Implausibility,
    KeptPose,
    PoseArrival,
    check_last_pose,
    check_program,
    check_seam,
    check_status,
    check_time,
    is_same_sample,
    mean_velocity_mm_s,
    newest_speed_mm_s,
    newest_turn_rad_s,
    turn_rad,
)
from robot_io.protocol.messages import MotionState, RobotStatus


@dataclass(frozen=True)
class _Anchor:
    """The last trusted sample before a doubt, with the velocity and the lateral ranges then.

    `is_steady` says that the robot has stated one motion since, on a clock that did not step.
    """

    kept: KeptPose
    velocity_mm_s: Vector
    lateral_mm: tuple[float, float]
    height_mm: tuple[float, float]
    is_steady: bool


@dataclass(frozen=True)
class Plausibility:
    """State of the plausibility of poses; a new one trusts nothing.

    `doubt` says why poses are not trusted, None where they are. `window` has the samples of the last second,
    none from before a jump. `stated` is the motion and travel speed, mm/s, that the robot stated last; from
    `steady_from_s` on poses must show it. Samples are without a doubt since `clean_from_s`, NaN where the
    newest is not. `anchor` is the last trusted sample before a doubt, None where poses are trusted.
    """

    doubt: Implausibility | None = Implausibility.UNPROVEN
    window: tuple[KeptPose, ...] = ()
    stated: tuple[MotionState, float] = (MotionState.UNKNOWN, math.nan)
    steady_from_s: float = math.inf
    clean_from_s: float = math.nan
    anchor: _Anchor | None = None

    @property
    def speed_mm_s(self) -> float:
        """The tool's speed by the newest samples, mm/s; 0 before there are two."""
        return newest_speed_mm_s(self.window) if self.window else 0.0

    @property
    def turn_rad_s(self) -> float:
        """The tool's rate of turning by the newest samples, rad/s; 0 before there are two."""
        return newest_turn_rad_s(self.window) if self.window else 0.0

    def at(self, now_s: float, limits: PlausibilityLimits) -> Implausibility | None:
        """Return the doubt at a time on the samples' clock, s; None where poses are trusted."""
        if not self.window:
            return Implausibility.UNPROVEN
        # Written so that a NaN, and a clock that was set back, fail.
        if not abs(now_s - self.window[-1].time_s) <= limits.gap_s:
            return Implausibility.STOPPED
        return self.doubt


def update(
    state: Plausibility, seen: PoseArrival, limits: PlausibilityLimits, path: NominalPath | None = None
) -> Plausibility:
    """Return the state after one more sample; its `doubt` names the first question that failed.

    Start a new seam with `Plausibility()`. Without `path`, place and progress along it are not tested.
    """
    sample = seen.sample
    if not all(map(math.isfinite, (sample.timestamp_s, *sample.position_base_mm, *sample.quaternion_xyzw))):
        raise ValueError("a pose with a value that is not finite: leave unknown poses out")
    place = None if path is None else path.place(sample.position_base_mm)
    newest = KeptPose(sample.timestamp_s, sample.position_base_mm, sample.quaternion_xyzw, place)
    state = _with_status(state, newest.time_s, seen.robot, limits)
    if is_same_sample(state.window, newest, limits):
        return state
    clock, window = check_time(state.window, newest, limits)
    if clock is Implausibility.TIME_REPEATED:
        return _with_doubt(state, clock)
    if clock is Implausibility.TIME_BACKWARDS:
        if window:
            return _with_doubt(state, clock)
        # That clock was set back: how long ago anything was is not known.
        state = clock_set(_with_doubt(state, clock), newest.time_s, limits)
    jump = check_last_pose(window, newest, limits)
    if jump is not None:
        # What came before a jump says nothing of the way after it.
        window = ()
    steady = window[bisect_left(window, state.steady_from_s, key=lambda k: k.time_s) :]
    doubt = (
        clock
        or jump
        or (Implausibility.AGE_UNKNOWN if limits.age_required and math.isnan(sample.sample_age_s) else None)
        or (None if seen.robot is None else check_status(state.stated, steady, newest, limits))
        or check_program(seen, newest, limits)
        or check_seam(newest, limits, path)
    )
    if doubt is not None:
        state = _with_doubt(state, doubt)
    first = bisect_left(window, newest.time_s - limits.window_s, key=lambda k: k.time_s)
    state = replace(state, window=(*window[first:], newest))
    return state if doubt is not None else _with_proof(state, newest, limits, seen.is_contradicted)


def _with_status(
    state: Plausibility, time_s: float, robot: RobotStatus | None, limits: PlausibilityLimits
) -> Plausibility:
    """Note what the robot says of its motion, and from when its poses must show it."""
    if robot is None:
        # If it says the same again, it is taken to have done so meanwhile.
        return state
    stated, before = (robot.motion, robot.travel_speed_mm_s), state.stated
    ripple_mm_s = max(limits.speed_change_mm_s, limits.speed_change_share * before[1])
    same_speed = stated[0] is not MotionState.MOVING or abs(stated[1] - before[1]) <= ripple_mm_s
    if stated[0] is before[0] and same_speed:
        return state
    return _restart_motion(replace(state, stated=stated), time_s + limits.settle_s)


def clock_set(state: Plausibility, now_s: float, limits: PlausibilityLimits) -> Plausibility:
    """Return the state after the samples' clock was set, s on that clock.

    Ages are unknown then, so the distance travelled since a doubt is not tested.
    """
    return _restart_motion(state, now_s + limits.settle_s)


def _restart_motion(state: Plausibility, until_s: float) -> Plausibility:
    anchor = state.anchor
    if anchor is not None:
        anchor = replace(anchor, is_steady=False)
    return replace(state, steady_from_s=until_s, anchor=anchor)


def _with_doubt(state: Plausibility, doubt: Implausibility) -> Plausibility:
    anchor = state.anchor
    if state.doubt is None:
        last, places = state.window[-1], [k.place for k in state.window if k.place is not None]
        laterals_mm, heights_mm = [p.lateral_mm for p in places], [p.height_mm for p in places]
        anchor = _Anchor(
            kept=last,
            velocity_mm_s=mean_velocity_mm_s(state.window),
            lateral_mm=(min(laterals_mm, default=math.nan), max(laterals_mm, default=math.nan)),
            height_mm=(min(heights_mm, default=math.nan), max(heights_mm, default=math.nan)),
            is_steady=last.time_s >= state.steady_from_s,
        )
    return replace(state, doubt=doubt, clean_from_s=math.nan, anchor=anchor)


def _with_proof(
    state: Plausibility, newest: KeptPose, limits: PlausibilityLimits, is_contradicted: bool
) -> Plausibility:
    """Return the state after a sample without a doubt: trusted again after enough of them."""
    if state.doubt is None:
        return state
    clean_from_s = newest.time_s if math.isnan(state.clean_from_s) else state.clean_from_s
    elsewhere = _check_rejoined(state, newest, limits)
    if elsewhere is not None:
        # The proof restarts: a weave alone may bring some samples of a displaced tool near.
        assert state.anchor is not None
        is_over = newest.time_s - state.anchor.kept.time_s >= limits.prove_s
        return replace(state, doubt=elsewhere if is_over else state.doubt, clean_from_s=math.nan)
    if newest.time_s - clean_from_s < limits.prove_s or is_contradicted:
        return replace(state, clean_from_s=clean_from_s)
    return replace(state, doubt=None, clean_from_s=math.nan, anchor=None)


def _check_rejoined(
    state: Plausibility, newest: KeptPose, limits: PlausibilityLimits
) -> Implausibility | None:
    """Hold a sample against where the tool would be since the last one that was trusted."""
    anchor = state.anchor
    if anchor is None:
        return None
    if turn_rad(newest.quaternion, anchor.kept.quaternion) > math.radians(limits.rejoin_deg):
        return Implausibility.NOT_REJOINED
    elapsed_s = newest.time_s - anchor.kept.time_s
    motion, speed_mm_s = state.stated
    here, there = newest.place, anchor.kept.place
    if here is None or there is None:
        moved_mm = times(elapsed_s, anchor.velocity_mm_s)
        off_mm = math.dist(minus(newest.position_mm, anchor.kept.position_mm), moved_mm)
        limit_mm = limits.rejoin_mm + limits.rejoin_share * math.hypot(*moved_mm)
        return Implausibility.NOT_REJOINED if off_mm > limit_mm else None
    for place_mm, (low_mm, high_mm) in (
        (here.lateral_mm, anchor.lateral_mm),
        (here.height_mm, anchor.height_mm),
    ):
        if not low_mm - limits.rejoin_mm <= place_mm <= high_mm + limits.rejoin_mm:
            return Implausibility.NOT_REJOINED
    if not anchor.is_steady or motion is not MotionState.MOVING or not speed_mm_s > 0.0:
        return None
    ahead_mm = here.station_mm - there.station_mm - speed_mm_s * elapsed_s
    noise_mm = limits.sigmas * math.sqrt(2.0) * limits.position_sigma_mm(speed_mm_s) + limits.weave_along_mm
    limit_mm = speed_mm_s * (limits.rejoin_late_s + limits.rejoin_share * abs(elapsed_s)) + noise_mm
    if ahead_mm < -limit_mm:
        return Implausibility.LATE
    # What was frozen stood for some time before that was seen.
    return Implausibility.NOT_REJOINED if ahead_mm > limit_mm + speed_mm_s * limits.frozen_s else None
