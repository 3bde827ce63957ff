"""Whether the poses that arrive are those of a robot that moves as it says.

Each sample is held against the ones before it (a robot has a largest speed, acceleration and rate of
turning), against what the robot says of its motion, against the programmed path, and against the nominal
seam. A sample that fails a question is doubted by name. Trust comes with `prove_s` of samples without a
doubt, and after a doubt only where the tool is again where it would be by what the robot said since: else the
doubt stays until the caller begins with a new state, for a new seam.

What poses alone cannot tell: a drift within the limits, and a delay or a flipped sign that moves the tool
across the seam by less than they allow. `docs/explanation/plausibility.md` says what tells those.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass, replace
from enum import Enum

from robot_io.described import described
from robot_io.poses.nominal_path import NominalPath, PathPlace, Vector, dot, minus, times
from robot_io.poses.plausibility_limits import PlausibilityLimits
from robot_io.poses.pose_assembler import PoseSample
from robot_io.protocol.messages import MotionState, RobotStatus

Quaternion = tuple[float, float, float, float]

SPEED_SAMPLES = 5
"""The speed that jitter is counted at comes from so many samples before the newest."""


@described
class Implausibility(Enum):
    """Why poses are not trusted."""

    UNPROVEN = "too few poses yet"
    AGE_UNKNOWN = "the sender does not say how old a pose is"
    TIME_REPEATED = "another pose of the same time"
    TIME_BACKWARDS = "a pose older than the one before"
    STOPPED = "no poses for too long"
    SPEED = "faster than the robot moves"
    ACCELERATION = "a sharper change of speed than the robot makes"
    ROTATION = "turns faster than the robot does"
    FROZEN = "the pose stands while the robot says that it moves"
    MOVES = "the pose moves while the robot says that it stands"
    BACKWARDS = "runs back along the path while the robot says that it moves on"
    PROGRESS = "moves on at another speed than the robot says"
    PROGRAMMED_PLACE = "too far off the programmed pose"
    PROGRAMMED_ROTATION = "turned against the programmed pose"
    OFF_SEAM = "too far from the nominal seam"
    AGAINST_SEAM = "does not look along the nominal seam"
    LATE = "behind on the path after a doubt: poses are late"
    NOT_REJOINED = "elsewhere than the robot would be since a doubt"


@dataclass(frozen=True)
class PoseSeen:
    """A sample and what was known when it came.

    Parameters
    ----------
    sample : PoseSample
        The sample, of where the tool is.
    robot : RobotStatus or None
        The robot's status; None while no fresh status has been received.
    programmed : PoseSample or None
        The newest sample of the programmed path, None where the robot sends none.
    is_contradicted : bool
        Whether the seam in the image moves otherwise than the poses say: no trust comes back meanwhile.
    """

    sample: PoseSample
    robot: RobotStatus | None
    programmed: PoseSample | None = None
    is_contradicted: bool = False


@dataclass(frozen=True)
class _Kept:
    time_s: float
    position_mm: Vector
    quaternion: Quaternion
    place: PathPlace | None


@dataclass(frozen=True)
class _Anchor:
    """The last trusted sample before a doubt, and the velocity and the ranges beside the path then.

    `is_steady` says that the robot has stated one motion since, on a clock that did not step.
    """

    kept: _Kept
    velocity_mm_s: Vector
    lateral_mm: tuple[float, float]
    height_mm: tuple[float, float]
    is_steady: bool


@dataclass(frozen=True)
class Plausibility:
    """What is known of the poses so far; a new one trusts nothing.

    Parameters
    ----------
    doubt : Implausibility or None
        Why poses are not trusted; None where they are.
    window : tuple
        The samples of the last second, none of them from before a jump.
    stated : tuple of MotionState and float
        The motion and the travel speed, mm/s, that the robot stated last.
    steady_from_s : float
        From when on, s, poses must show that motion.
    clean_from_s : float
        Since when, s, samples are without a doubt; NaN where the newest is not.
    anchor : object or None
        The last trusted sample before a doubt; None where poses are trusted.
    """

    doubt: Implausibility | None = Implausibility.UNPROVEN
    window: tuple[_Kept, ...] = ()
    stated: tuple[MotionState, float] = (MotionState.UNKNOWN, math.nan)
    steady_from_s: float = math.inf
    clean_from_s: float = math.nan
    anchor: _Anchor | None = None

    @property
    def speed_mm_s(self) -> float:
        """The tool's speed by the newest samples, mm/s; 0 before there are two."""
        return _speed_mm_s(self.window) if self.window else 0.0

    def at(self, now_s: float, limits: PlausibilityLimits) -> Implausibility | None:
        """Return the doubt at a time: poses may have stopped since the last.

        Parameters
        ----------
        now_s : float
            The time, s, on the samples' clock.
        limits : PlausibilityLimits
            What poses must keep to.

        Returns
        -------
        Implausibility or None
            Why poses are not trusted then; None where they are.
        """
        if not self.window:
            return Implausibility.UNPROVEN
        # Written so that a NaN, and a clock that was set back, fail.
        if not abs(now_s - self.window[-1].time_s) <= limits.gap_s:
            return Implausibility.STOPPED
        return self.doubt


def update(
    state: Plausibility, seen: PoseSeen, limits: PlausibilityLimits, path: NominalPath | None = None
) -> Plausibility:
    """Return the state after one more sample.

    Parameters
    ----------
    state : Plausibility
        The state before; `Plausibility()` for a new seam.
    seen : PoseSeen
        The sample, and what the robot said when it came.
    limits : PlausibilityLimits
        What poses must keep to.
    path : NominalPath, optional
        The nominal seam. Without it nothing is asked of the place, nor of the progress along it.

    Returns
    -------
    Plausibility
        The state, whose `doubt` names the first question that failed.
    """
    sample = seen.sample
    if not all(map(math.isfinite, (sample.timestamp_s, *sample.position_base_mm, *sample.quaternion_xyzw))):
        raise ValueError("a pose with a value that is not finite: leave unknown poses out")
    place = None if path is None else path.place(sample.position_base_mm)
    newest = _Kept(sample.timestamp_s, sample.position_base_mm, sample.quaternion_xyzw, place)
    state = _with_status(state, newest.time_s, seen.robot, limits)
    if _is_same_sample(state.window, newest, limits):
        return state
    clock, window = _on_the_clock(state.window, newest, limits)
    if clock is Implausibility.TIME_REPEATED:
        return _doubted(state, clock)
    if clock is Implausibility.TIME_BACKWARDS:
        if window:
            return _doubted(state, clock)
        # That clock was set back: how long ago anything was is not known.
        state = clock_set(_doubted(state, clock), newest.time_s, limits)
    jump = _against_the_last(window, newest, limits)
    if jump is not None:
        # What came before a jump says nothing of the way after it.
        window = ()
    doubt = (
        clock
        or jump
        or (Implausibility.AGE_UNKNOWN if limits.age_required and math.isnan(sample.sample_age_s) else None)
        or (None if seen.robot is None else _against_the_status(state, window, newest, limits))
        or _against_the_program(seen, newest, limits)
        or _against_the_seam(newest, limits, path)
    )
    if doubt is not None:
        state = _doubted(state, doubt)
    first = bisect_left(window, newest.time_s - limits.window_s, key=lambda k: k.time_s)
    state = replace(state, window=(*window[first:], newest))
    return state if doubt is not None else _proven(state, newest, limits, seen.is_contradicted)


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
    return _unsteady(replace(state, stated=stated), time_s + limits.settle_s)


def clock_set(state: Plausibility, now_s: float, limits: PlausibilityLimits) -> Plausibility:
    """Return the state after someone learnt that the samples' clock was set, s on that clock.

    How long ago anything was is not known then: the way since a doubt is not asked for.
    """
    return _unsteady(state, now_s + limits.settle_s)


def _unsteady(state: Plausibility, until_s: float) -> Plausibility:
    anchor = state.anchor
    if anchor is not None:
        anchor = replace(anchor, is_steady=False)
    return replace(state, steady_from_s=until_s, anchor=anchor)


def _is_same_sample(window: tuple[_Kept, ...], newest: _Kept, limits: PlausibilityLimits) -> bool:
    """Say whether a sample is the last one, sent again with its age: it says nothing new, and nothing wrong.

    Both times have the jitter of their ways over the bus.
    """
    if not window:
        return False
    last = window[-1]
    apart_s = limits.sigmas * math.sqrt(2.0) * limits.time_jitter_s
    return (
        newest.position_mm == last.position_mm
        and newest.quaternion == last.quaternion
        and abs(newest.time_s - last.time_s) <= apart_s
    )


def _on_the_clock(
    window: tuple[_Kept, ...], newest: _Kept, limits: PlausibilityLimits
) -> tuple[Implausibility | None, tuple[_Kept, ...]]:
    """Hold a sample's time against the last; the window begins anew where nothing is known in between."""
    if not window:
        return None, window
    elapsed_s = newest.time_s - window[-1].time_s
    if elapsed_s < -limits.gap_s:
        return Implausibility.TIME_BACKWARDS, ()
    if elapsed_s > limits.gap_s:
        return Implausibility.STOPPED, ()
    if elapsed_s < 0.0:
        return Implausibility.TIME_BACKWARDS, window
    return (Implausibility.TIME_REPEATED if elapsed_s == 0.0 else None), window


def _against_the_last(
    window: tuple[_Kept, ...], newest: _Kept, limits: PlausibilityLimits
) -> Implausibility | None:
    if not window:
        return None
    last = window[-1]
    step_s = newest.time_s - last.time_s
    sigma_mm = limits.position_sigma_mm(_speed_mm_s(window))
    moved_mm = math.dist(newest.position_mm, last.position_mm)
    if moved_mm > limits.speed_mm_s * step_s + limits.sigmas * math.sqrt(2.0) * sigma_mm:
        return Implausibility.SPEED
    rate_rad_s = math.radians(limits.rotation_deg_s)
    turn_sigma = limits.rotation_sigma_rad(rate_rad_s)
    turned = turn_rad(newest.quaternion, last.quaternion)
    if turned > rate_rad_s * step_s + limits.sigmas * math.sqrt(2.0) * turn_sigma:
        return Implausibility.ROTATION
    if len(window) < 2:
        return None
    # The second divided difference: of a steady acceleration it is that, whatever the spacing. Its weights
    # say how far errors of the three samples reach.
    before = window[-2]
    first_s, whole_s = last.time_s - before.time_s, newest.time_s - before.time_s
    w_new, w_before = 2.0 / (step_s * whole_s), 2.0 / (first_s * whole_s)
    w_last = w_new + w_before
    acceleration = math.hypot(
        *(
            w_new * n - w_last * m + w_before * b
            for n, m, b in zip(newest.position_mm, last.position_mm, before.position_mm, strict=True)
        )
    )
    noise = sigma_mm * math.hypot(w_new, w_last, w_before)
    if acceleration > limits.acceleration_mm_s2 + limits.sigmas * noise:
        return Implausibility.ACCELERATION
    return None


def _against_the_status(
    state: Plausibility, window: tuple[_Kept, ...], newest: _Kept, limits: PlausibilityLimits
) -> Implausibility | None:
    motion, speed_mm_s = state.stated
    steady = window[bisect_left(window, state.steady_from_s, key=lambda k: k.time_s) :]
    if not steady:
        return None
    if motion in (MotionState.STOPPED, MotionState.PAUSED):
        noise_mm = limits.sigmas * math.sqrt(2.0) * limits.position_sigma_mm(0.0)
        moved_mm = math.dist(newest.position_mm, steady[0].position_mm)
        return Implausibility.MOVES if moved_mm > limits.still_mm + noise_mm else None
    if motion is not MotionState.MOVING or not speed_mm_s > 0.0:
        return None
    noise_mm = limits.sigmas * math.sqrt(2.0) * limits.position_sigma_mm(speed_mm_s) + limits.weave_along_mm
    # Twice the noise, so that neither a still tool passes nor one fails that is as slow as it may be.
    long_s = max(limits.frozen_s, 2.0 * noise_mm / (speed_mm_s * (1.0 - limits.speed_share)))
    compared = next((k for k in reversed(steady) if newest.time_s - k.time_s >= long_s), None)
    if compared is None:
        return None
    if math.dist(newest.position_mm, compared.position_mm) <= noise_mm:
        return Implausibility.FROZEN
    if _moved_mm(compared, newest) < -noise_mm:
        return Implausibility.BACKWARDS
    stated_mm = speed_mm_s * (newest.time_s - steady[0].time_s)
    if abs(_moved_mm(steady[0], newest) - stated_mm) > limits.speed_share * stated_mm + noise_mm:
        return Implausibility.PROGRESS
    return None


def _moved_mm(first: _Kept, newest: _Kept) -> float:
    """Return the way along one straight piece of the path, mm; NaN between two, and without a path."""
    if newest.place is None or first.place is None or newest.place.segment != first.place.segment:
        return math.nan
    return newest.place.station_mm - first.place.station_mm


def _against_the_program(seen: PoseSeen, newest: _Kept, limits: PlausibilityLimits) -> Implausibility | None:
    programmed = seen.programmed
    if programmed is None:
        return None
    apart_s = abs(newest.time_s - programmed.timestamp_s)
    if apart_s > limits.programmed_age_s:
        return None
    stated_mm_s = math.nan if seen.robot is None else seen.robot.travel_speed_mm_s
    speed_mm_s = limits.speed_mm_s if math.isnan(stated_mm_s) else stated_mm_s
    lag_mm = speed_mm_s * (apart_s + limits.follow_s)
    if math.dist(newest.position_mm, programmed.position_base_mm) > limits.programmed_mm + lag_mm:
        return Implausibility.PROGRAMMED_PLACE
    if turn_rad(newest.quaternion, programmed.quaternion_xyzw) > math.radians(limits.programmed_deg):
        return Implausibility.PROGRAMMED_ROTATION
    return None


def _against_the_seam(
    newest: _Kept, limits: PlausibilityLimits, path: NominalPath | None
) -> Implausibility | None:
    place = newest.place
    if place is None:
        return None
    assert path is not None
    is_near = (
        abs(place.lateral_mm) <= limits.lateral_mm
        and -limits.below_mm <= place.height_mm <= limits.above_mm
        and -limits.ends_mm <= place.station_mm <= path.length_mm + limits.ends_mm
    )
    if not is_near:
        return Implausibility.OFF_SEAM
    x_tool, z_tool = _tool_axes(newest.quaternion)
    cos_travel = math.cos(math.radians(limits.travel_deg))
    cos_tilt = math.cos(math.radians(limits.tilt_deg))
    # Round a corner the tool may look along either piece.
    pieces = path.segments_near(newest.position_mm, limits.lateral_mm)
    if any(dot(x_tool, p.along) >= cos_travel and dot(z_tool, p.up) >= cos_tilt for p in pieces):
        return None
    return Implausibility.AGAINST_SEAM


def _doubted(state: Plausibility, doubt: Implausibility) -> Plausibility:
    anchor = state.anchor
    if state.doubt is None:
        last, places = state.window[-1], [k.place for k in state.window if k.place is not None]
        laterals_mm, heights_mm = [p.lateral_mm for p in places], [p.height_mm for p in places]
        anchor = _Anchor(
            kept=last,
            velocity_mm_s=_velocity_mm_s(state.window),
            lateral_mm=(min(laterals_mm, default=math.nan), max(laterals_mm, default=math.nan)),
            height_mm=(min(heights_mm, default=math.nan), max(heights_mm, default=math.nan)),
            is_steady=last.time_s >= state.steady_from_s,
        )
    return replace(state, doubt=doubt, clean_from_s=math.nan, anchor=anchor)


def _proven(
    state: Plausibility, newest: _Kept, limits: PlausibilityLimits, is_contradicted: bool
) -> Plausibility:
    """Return the state after a sample without a doubt: trusted again after enough of them."""
    if state.doubt is None:
        return state
    clean_from_s = newest.time_s if math.isnan(state.clean_from_s) else state.clean_from_s
    elsewhere = _elsewhere(state, newest, limits)
    if elsewhere is not None:
        # The proof begins anew: of a tool that is elsewhere a weave alone may bring some samples near.
        assert state.anchor is not None
        is_over = newest.time_s - state.anchor.kept.time_s >= limits.prove_s
        return replace(state, doubt=elsewhere if is_over else state.doubt, clean_from_s=math.nan)
    if newest.time_s - clean_from_s < limits.prove_s or is_contradicted:
        return replace(state, clean_from_s=clean_from_s)
    return replace(state, doubt=None, clean_from_s=math.nan, anchor=None)


def _elsewhere(state: Plausibility, newest: _Kept, limits: PlausibilityLimits) -> Implausibility | None:
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


def _velocity_mm_s(window: tuple[_Kept, ...]) -> Vector:
    first, last = window[0], window[-1]
    elapsed_s = last.time_s - first.time_s
    if elapsed_s <= 0.0:
        return (0.0, 0.0, 0.0)
    return times(1.0 / elapsed_s, minus(last.position_mm, first.position_mm))


def _speed_mm_s(window: tuple[_Kept, ...]) -> float:
    return math.hypot(*_velocity_mm_s(window[-SPEED_SAMPLES:]))


def turn_rad(a: Quaternion, b: Quaternion) -> float:
    """Return the angle between two rotations, rad; q and -q are the same."""
    opposite = (-b[0], -b[1], -b[2], -b[3])
    return 4.0 * math.asin(min(1.0, 0.5 * min(math.dist(a, b), math.dist(a, opposite))))


def _tool_axes(q: Quaternion) -> tuple[Vector, Vector]:
    """Return the tool's x and z in base."""
    x, y, z, w = q
    x_tool = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w))
    z_tool = (2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y))
    return x_tool, z_tool
