"""Tests of a sample of the tool's pose, and the names of the doubts that they raise.

Each function returns the doubt that a sample raises, None where it raises none.
"""

import math
from dataclasses import dataclass
from enum import Enum

from robot_io.described_enum import described
from robot_io.poses.nominal_path import NominalPath, PathPlace, Quaternion, Vector, dot, minus, times
from robot_io.poses.plausibility_limits import PlausibilityLimits
from robot_io.poses.pose_assembler import PoseSample
from robot_io.protocol.messages import MotionState, RobotStatus


@described
class Implausibility(Enum):
    """Reason for which poses are not trusted."""

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
class PoseArrival:
    """A pose sample of the tool and what was known when it came.

    `robot` is None while no fresh status has been received. `programmed` is the newest sample of the
    programmed path, None where the robot sends none. While the seam in the image moves otherwise than the
    poses say (`is_contradicted`), no trust comes back.
    """

    sample: PoseSample
    robot: RobotStatus | None
    programmed: PoseSample | None = None
    is_contradicted: bool = False


@dataclass(frozen=True)
class KeptPose:
    """A sample that later ones are held against, and its place on the nominal path."""

    time_s: float
    position_mm: Vector
    quaternion: Quaternion
    place: PathPlace | None


def is_same_sample(window: tuple[KeptPose, ...], newest: KeptPose, limits: PlausibilityLimits) -> bool:
    """Return True if a sample is the last one sent again: then it counts neither way.

    Both times have the jitter of their transit over the bus.
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


def check_time(
    window: tuple[KeptPose, ...], newest: KeptPose, limits: PlausibilityLimits
) -> tuple[Implausibility | None, tuple[KeptPose, ...]]:
    """Compare a sample's time with the last; the window restarts where nothing is known in between."""
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


def check_last_pose(
    window: tuple[KeptPose, ...], newest: KeptPose, limits: PlausibilityLimits
) -> Implausibility | None:
    """Hold a sample against the last ones: a robot has a largest speed, rate of turning and acceleration."""
    if not window:
        return None
    last = window[-1]
    step_s = newest.time_s - last.time_s
    sigma_mm = limits.position_sigma_mm(newest_speed_mm_s(window))
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


def check_status(
    stated: tuple[MotionState, float],
    steady: tuple[KeptPose, ...],
    newest: KeptPose,
    limits: PlausibilityLimits,
) -> Implausibility | None:
    """Hold a sample, with the `steady` ones before it, against the stated motion and speed, mm/s."""
    motion, speed_mm_s = stated
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


def _moved_mm(first: KeptPose, newest: KeptPose) -> float:
    """Return the way along one straight piece of the path, mm; NaN between two, and without a path."""
    if newest.place is None or first.place is None or newest.place.segment != first.place.segment:
        return math.nan
    return newest.place.station_mm - first.place.station_mm


def check_program(seen: PoseArrival, newest: KeptPose, limits: PlausibilityLimits) -> Implausibility | None:
    """Hold a sample against the programmed one of the same time, where there is one."""
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


def check_seam(
    newest: KeptPose, limits: PlausibilityLimits, path: NominalPath | None
) -> Implausibility | None:
    """Hold a sample against the nominal seam: its distance, and the way that the tool looks."""
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


def mean_velocity_mm_s(window: tuple[KeptPose, ...]) -> Vector:
    """Return the velocity from the first sample of a window to its last, mm/s."""
    first, last = window[0], window[-1]
    elapsed_s = last.time_s - first.time_s
    if elapsed_s <= 0.0:
        return (0.0, 0.0, 0.0)
    return times(1.0 / elapsed_s, minus(last.position_mm, first.position_mm))


def newest_speed_mm_s(window: tuple[KeptPose, ...]) -> float:
    """Return the speed over the newest samples of a window, mm/s."""
    return math.hypot(*mean_velocity_mm_s(window[-5:]))


def newest_turn_rad_s(window: tuple[KeptPose, ...]) -> float:
    """Return the rate of turning over the newest samples of a window, rad/s."""
    first, last = window[-5:][0], window[-1]
    elapsed_s = last.time_s - first.time_s
    return turn_rad(first.quaternion, last.quaternion) / elapsed_s if elapsed_s > 0.0 else 0.0


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
