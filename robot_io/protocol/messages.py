"""Messages of the bus, as frozen dataclasses in physical units.

The fields bear the names of the signals in `arctrack.dbc`, units included. A number that is not known is NaN,
a count that is not known is None, a state that is not known is its enumeration's UNKNOWN: never 0.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Self


class Source(IntEnum):
    """Origin of a sender's data."""

    LIVE = 0
    REPLAY = 1
    SIMULATION = 2
    UNKNOWN = 3


class PoseKind(IntEnum):
    """Kind of a pose: of the TCP, or of the programmed path."""

    ACTUAL = 0
    PROGRAMMED = 1


class QuaternionComponent(IntEnum):
    """A component of a quaternion in the order x y z w."""

    X = 0
    Y = 1
    Z = 2
    W = 3


class Validity(IntEnum):
    """Validity of an offset."""

    VALID = 0
    HELD = 1
    REFUSED = 2
    UNKNOWN = 7


class RobotMode(IntEnum):
    """Operating mode of the controller."""

    MANUAL = 0
    AUTOMATIC = 1
    DRY_RUN = 2
    UNKNOWN = 7


class MotionState(IntEnum):
    """Motion along the programmed path."""

    STOPPED = 0
    MOVING = 1
    PAUSED = 2
    RETRACTING = 3
    UNKNOWN = 7


class WeldingState(IntEnum):
    """Step of the welding sequence."""

    OFF = 0
    GAS_PREFLOW = 1
    IGNITING = 2
    WELDING = 3
    CRATER_FILL = 4
    GAS_POSTFLOW = 5
    FAULT = 6
    UNKNOWN = 7


class Switch(IntEnum):
    """On, off, or not known."""

    OFF = 0
    ON = 1
    UNKNOWN = 3


class Command(IntEnum):
    """Command of the robot to the tracker; ARM is the name that layout 1.1 has for TRACK."""

    DISARM = 0
    ARM = 1
    RESET = 2
    SEARCH = 3
    TRACK = 4
    HOLD = 5
    STORE_ZERO = 6
    FIND = 7


class JointType(IntEnum):
    """Type of joint that a measurement stands on."""

    FLAT = 0
    V_GROOVE = 1
    LAP = 2
    CORRUGATION = 3
    BUTT = 4
    FILLET = 5
    HALF_V = 6
    U_GROOVE = 7
    EDGE = 8
    OUTSIDE_CORNER = 9
    FREE = 10
    UNKNOWN = 15


class TrackerState(IntEnum):
    """State of the tracker."""

    STARTING = 0
    DISARMED = 1
    SEARCHING = 2
    TRACKING = 3
    HOLDING = 4
    FAULT = 5
    UNKNOWN = 15


class GateReason(IntEnum):
    """Reason for which the gate did not let an offset through as it was measured."""

    NONE = 0
    NOT_ARMED = 1
    ROBOT_STATUS_STALE = 2
    EMERGENCY_STOP = 3
    NOT_AUTOMATIC = 4
    CORRECTION_OFF = 5
    ARC_OFF = 6
    NO_AXIS_ENABLED = 7
    NOT_MEASURED = 8
    CAPTURE_IN_FUTURE = 9
    CAPTURE_TOO_OLD = 10
    LOW_CONFIDENCE = 11
    SIGMA_TOO_LARGE = 12
    OUT_OF_RANGE = 13
    RATE_TOO_HIGH = 14
    ROBOT_NOT_MOVING = 15
    WELDING_FAULT = 16
    NOT_WELDING = 17
    POSE_IMPLAUSIBLE = 18
    ROBOT_ELSEWHERE = 19
    JUMP = 20
    HEARTBEAT_LOST = 21
    OTHER_TRACKER = 22
    CAMERA_STOPPED = 23
    SHUTTING_DOWN = 24
    SOFT_START = 25
    SEARCH_ONLY = 26
    HOLD_COMMANDED = 27
    JOB_UNKNOWN = 28
    PART_REFUSED = 29
    BUS_DELAYED = 30
    UNKNOWN = 31


class LaserState(IntEnum):
    """State of the laser."""

    OFF = 0
    ON = 1
    INTERLOCK_OPEN = 2
    FAULT = 3
    UNKNOWN = 7


class Fault(IntEnum):
    """Reason for which the tracker is in FAULT."""

    NONE = 0
    OTHER_TRACKER = 1
    GAP = 2
    MISMATCH = 3
    DEPTH = 4
    ANGLE = 5
    BRIDGED_TOO_FAR = 6
    UNKNOWN = 31


class RequestResult(IntEnum):
    """Result of a request that acts once."""

    NONE = 0
    DONE = 1
    REFUSED = 2
    UNKNOWN = 7


class FindRefusal(IntEnum):
    """Reason for which a FIND found no joint.

    FRAME_UNREADABLE to STRIPE_AMBIGUOUS are flags of `tracker.flags`, GAP to ANGLE the part's limits.
    """

    NONE = 0
    FRAME_UNREADABLE = 1
    LASER_OFF = 2
    POSE_REFUSED = 3
    STRIPE_LOST = 4
    JOINT_NOT_FOUND = 5
    SEAM_OUT_OF_VIEW = 6
    SEAM_JUMP = 7
    BELOW_SURFACE = 8
    SEAM_REVERSED = 9
    STRIPE_AMBIGUOUS = 10
    GAP = 11
    MISMATCH = 12
    DEPTH = 13
    ANGLE = 14
    POSES_DOUBTED = 15
    MOVED_TOO_FAR = 16
    SIGMA_TOO_LARGE = 17
    OUT_OF_RANGE = 18
    CAMERA_STOPPED = 19
    ARC_ON = 20
    ROBOT_STATUS_STALE = 21
    BUS_DELAYED = 22
    JOB_UNKNOWN = 23
    FAULT = 24
    WITHDRAWN = 25
    SHUTTING_DOWN = 26
    NOT_AVAILABLE = 27
    UNKNOWN = 31


class CommandHeard(IntEnum):
    """Command that a tracker obeys; NOT_STATED is a tracker of a layout before 1.6."""

    NOT_STATED = 0
    NONE = 1
    LOST = 2
    DISARM = 3
    OTHER = 4
    UNKNOWN = 7


@dataclass(frozen=True)
class BusMessage:
    """Any message of the bus."""


@dataclass(frozen=True)
class RobotPosePosition(BusMessage):
    """Position of the TCP in base, mm; one half of a pose."""

    x_mm: float
    y_mm: float
    z_mm: float
    kind: PoseKind


@dataclass(frozen=True)
class BusRotation(BusMessage):
    """A rotation as the three smaller components of its unit quaternion."""

    largest: QuaternionComponent
    small_a: float
    small_b: float
    small_c: float

    @classmethod
    def from_quaternion(
        cls, quaternion_xyzw: tuple[float, float, float, float], *others: float, **named: float
    ) -> Self:
        """Return the message of a unit quaternion x y z w, and of its other fields in their order or by name.

        Raises ValueError if the quaternion is not finite or its norm is off 1 by more than 0.001.
        """
        norm = math.hypot(*quaternion_xyzw)
        if not abs(norm - 1.0) <= 1e-3:
            raise ValueError(f"quaternion {quaternion_xyzw}: norm {norm:.6g} is not 1; normalise it first")
        largest = max(QuaternionComponent, key=lambda component: abs(quaternion_xyzw[component]))
        factor = math.copysign(1.0 / norm, quaternion_xyzw[largest])
        small = [factor * quaternion_xyzw[c] for c in QuaternionComponent if c is not largest]
        return cls(largest, *small, *others, **named)

    @property
    def quaternion_xyzw(self) -> tuple[float, float, float, float]:
        """The unit quaternion x y z w; all NaN if unknown, or if the three cannot be the smaller ones."""
        small = (self.small_a, self.small_b, self.small_c)
        rest = 1.0 - math.fsum(component**2 for component in small)
        # The largest of four components is at least 1/2; 1 % of slack covers the rounding of the other three.
        if not rest >= 0.2475:
            return (math.nan, math.nan, math.nan, math.nan)
        whole = list(small)
        whole.insert(self.largest, math.sqrt(rest))
        return (whole[0], whole[1], whole[2], whole[3])


@dataclass(frozen=True)
class RobotPoseRotation(BusRotation):
    """Rotation of T_base_tool; one half of a pose.

    `sample_age_ms` is the time from the controller's sample to the sending of this frame.
    """

    sample_age_ms: float = math.nan


@dataclass(frozen=True)
class SeamOffset(BusMessage):
    """Absolute displacement of the true seam from the programmed path, mm in S (y left, z out of the work).

    `capture_age_ms` runs from mid-exposure to sending, `confidence` is a probability 0 … 1.
    """

    offset_y_mm: float
    offset_z_mm: float
    capture_age_ms: float
    confidence: float
    validity: Validity


@dataclass(frozen=True)
class SeamPoint(BusMessage):
    """Seam point on the laser sheet, mm in base, at the capture of the SeamOffset sent before it."""

    x_mm: float
    y_mm: float
    z_mm: float


@dataclass(frozen=True)
class RobotSync(BusMessage):
    """The robot's clock, and how long the exchange before took on its way there and back."""

    sequence: int
    robot_time_us: int
    last_round_trip_us: int | None


@dataclass(frozen=True)
class TrackerSyncEcho(BusMessage):
    """The answer to a RobotSync; `echo_delay_us` runs from its arrival to the sending of this frame."""

    sequence: int
    echo_delay_us: int | None
    source: Source


@dataclass(frozen=True)
class RobotPulse(BusMessage):
    """The pulse of the welding current, and how long ago a base phase began."""

    period_us: int | None
    base_us: int | None
    begin_age_ms: float


@dataclass(frozen=True)
class FindResult(BusMessage):
    """Answer to a FIND, whose `request_number` it bears: refusal, gap, mismatch, 1 σ of the position; mm.

    `joint_misfit` says that what was found does not look as the joint is stated. FoundPosition and
    FoundRotation follow; see `FindAssembler`.
    """

    request_number: int
    refusal: FindRefusal
    gap_mm: float
    mismatch_mm: float
    sigma_y_mm: float
    sigma_z_mm: float
    joint_misfit: bool


@dataclass(frozen=True)
class RobotStatus(BusMessage):
    """Status of the robot and the power source."""

    mode: RobotMode
    motion: MotionState
    welding: WeldingState
    arc: Switch
    emergency_stop: Switch
    correction: Switch
    weave: Switch
    current_a: float
    travel_speed_mm_s: float
    path_section: int | None


@dataclass(frozen=True)
class TrackerCommand(BusMessage):
    """Command of the robot to the tracker, and its heartbeat: the latest one holds."""

    command: Command
    enable_y: bool
    enable_z: bool
    request_number: int
    job_number: int | None
    program_number: int | None
    laser_enable: Switch


@dataclass(frozen=True)
class SeamGeometry(BusMessage):
    """Measured joint: gap ≥ 0, mismatch (left minus right), 1 σ of the seam point; all mm."""

    gap_mm: float
    mismatch_mm: float
    sigma_y_mm: float
    sigma_z_mm: float
    joint: JointType


@dataclass(frozen=True)
class TrackerStatus(BusMessage):
    """Status of the tracker.

    `arc_level` is the arc's output over what the setup expects, `map_misfit` the 90 % quantile of the arc's
    residual over its stated uncertainty, as a share of a normal law's.
    """

    state: TrackerState
    gate_reason: GateReason
    frame_unreadable: bool
    stripe_lost: bool
    joint_not_found: bool
    saturated: bool
    arc_map_distrusted: bool
    pose_extrapolated: bool
    pose_refused: bool
    robot_stale: bool
    arc_level: float
    map_misfit: float
    dropped_frames_mod256: int
    latency_ms: float


@dataclass(frozen=True)
class TrackerHeartbeat(BusMessage):
    """Heartbeat of the tracker, with its state."""

    state: TrackerState
    source: Source
    laser: LaserState
    fault: Fault
    request_number: int
    request_result: RequestResult
    job_number: int | None
    rolling: int
    command_heard: CommandHeard = CommandHeard.NOT_STATED


@dataclass(frozen=True)
class FoundPosition(BusMessage):
    """Position of a found joint in base, mm; a part of the answer to a FIND."""

    x_mm: float
    y_mm: float
    z_mm: float


@dataclass(frozen=True)
class FoundRotation(BusRotation):
    """Rotation in base of a found joint: x along the seam, y to its left, z out of the work.

    1 σ of its direction, NaN where x is the nominal seam's, and of its normal about the seam, NaN where z is
    the nominal one; degrees. A part of the answer to a FIND.
    """

    direction_sigma_deg: float
    normal_sigma_deg: float


@dataclass(frozen=True)
class DbcVersion(BusMessage):
    """Version of the bus layout that the tracker uses."""

    major: int
    minor: int
    patch: int
    layout_checksum: int
    source: Source


MESSAGE_TYPES: tuple[type[BusMessage], ...] = (
    RobotPosePosition,
    RobotPoseRotation,
    SeamOffset,
    SeamPoint,
    RobotSync,
    TrackerSyncEcho,
    RobotPulse,
    FindResult,
    RobotStatus,
    TrackerCommand,
    SeamGeometry,
    TrackerStatus,
    TrackerHeartbeat,
    FoundPosition,
    FoundRotation,
    DbcVersion,
)
"""Every message type, in order of its id on the bus."""
