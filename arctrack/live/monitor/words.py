"""Texts on states, faults and reasons for a person at the cell: what is so, and what helps."""

from enum import Enum

from arctrack.control.processor import DELAYS, TOO_BUSY
from robot_io import Command, Fault, GateReason, LaserState, TrackerState, Validity

STATES = {
    TrackerState.STARTING: "No robot has been heard yet.",
    TrackerState.DISARMED: "The tracker waits until the robot commands TRACK.",
    TrackerState.SEARCHING: "The seam is looked for.",
    TrackerState.TRACKING: "Offsets follow the seam.",
    TrackerState.HOLDING: "The last offset holds.",
    TrackerState.FAULT: "Nothing goes out until the robot sends RESET.",
    TrackerState.UNKNOWN: "The state is not known.",
}

FAULTS = {
    Fault.NONE: "",
    Fault.OTHER_TRACKER: "Another tracker speaks on this bus. End one of the two, then send RESET.",
    Fault.GAP: "The part's gap is out of its range. Mend or change the part, then send RESET.",
    Fault.MISMATCH: "The part's mismatch is out of its range. Mend or change the part, then send RESET.",
    Fault.DEPTH: "The groove's depth is out of its range. Mend or change the part, then send RESET.",
    Fault.ANGLE: "The groove's angle is out of its range. Mend or change the part, then send RESET.",
    Fault.BRIDGED_TOO_FAR: "No joint was seen for longer than the job allows. Send RESET.",
    Fault.UNKNOWN: "The fault is not known. Send RESET.",
}

REASONS = {
    GateReason.NONE: "",
    GateReason.NOT_ARMED: "The robot does not command TRACK.",
    GateReason.ROBOT_STATUS_STALE: "The robot's status is too old. Check the bus and its program.",
    GateReason.EMERGENCY_STOP: "The emergency stop is pressed.",
    GateReason.NOT_AUTOMATIC: "The robot is not in automatic mode.",
    GateReason.CORRECTION_OFF: "The robot's path correction is off.",
    GateReason.ARC_OFF: "The arc is off.",
    GateReason.NO_AXIS_ENABLED: "The robot enables neither y nor z.",
    GateReason.NOT_MEASURED: "No seam is measured for the place where the torch stands.",
    GateReason.CAPTURE_IN_FUTURE: "The frame's time lies ahead of the clock. Check the camera's clock.",
    GateReason.CAPTURE_TOO_OLD: "The frame is too old: a slow machine, or a wrong clock of the camera.",
    GateReason.LOW_CONFIDENCE: "The seam is not known surely enough.",
    GateReason.SIGMA_TOO_LARGE: "The seam is not known precisely enough.",
    GateReason.OUT_OF_RANGE: "The seam lies farther off than the gate allows.",
    GateReason.RATE_TOO_HIGH: "The offset would change faster than the gate allows.",
    GateReason.ROBOT_NOT_MOVING: "The robot stands.",
    GateReason.WELDING_FAULT: "The power source has a fault.",
    GateReason.NOT_WELDING: "The robot does not weld.",
    GateReason.POSE_IMPLAUSIBLE: "The robot's poses cannot be right. Check them, and the hand-eye.",
    GateReason.ROBOT_ELSEWHERE: "The robot stands elsewhere than the recorded one did.",
    GateReason.JUMP: "The seam has jumped.",
    GateReason.HEARTBEAT_LOST: "The robot's heartbeat is lost. Check the bus.",
    GateReason.OTHER_TRACKER: "Another tracker speaks on this bus.",
    GateReason.CAMERA_STOPPED: "The camera gives no frames. Check its cable and its program.",
    GateReason.SHUTTING_DOWN: "The tracker ends.",
    GateReason.SOFT_START: "The offset moves slowly from zero to the seam.",
    GateReason.SEARCH_ONLY: "The robot commands SEARCH: no offset goes out.",
    GateReason.HOLD_COMMANDED: "The robot commands HOLD.",
    GateReason.JOB_UNKNOWN: "The robot names a job that the cell file does not hold.",
    GateReason.PART_REFUSED: "The part was not measured before the arc was lit.",
    GateReason.BUS_DELAYED: "Messages are too long on their way over the bus.",
    GateReason.UNKNOWN: "The reason is not known.",
}

NOTHING_SENT = "No offset goes out: no frame comes, or the bus takes no message."
NO_DISARM = "The robot commands TRACK without a DISARM before it. Send DISARM, then TRACK."

LASERS = {
    LaserState.OFF: "off",
    LaserState.ON: "on",
    LaserState.INTERLOCK_OPEN: "interlock open",
    LaserState.FAULT: "fault",
    LaserState.UNKNOWN: "not known",
}


class Indication(Enum):
    """Meaning of a colour and shape: the state, unless offsets that it promises are not sent."""

    STARTING = "starting"
    DISARMED = "disarmed"
    SEARCHING = "searching"
    TRACKING = "tracking"
    HOLDING = "holding"
    NO_OFFSETS = "no offsets"
    FAULT = "fault"


def indication_of(
    state: TrackerState, command: Command | None, validity: Validity | None, offset_age_s: float
) -> Indication:
    """Return what the page indicates.

    `command` is the robot's last one, however old; `validity` is the newest offset's, and `offset_age_s` the
    age of the last offset that the robot may use.
    """
    if state in (TrackerState.FAULT, TrackerState.STARTING):
        return Indication[state.name]
    is_following = state in (TrackerState.SEARCHING, TrackerState.TRACKING, TrackerState.HOLDING)
    # One bad frame is no alarm.
    if is_following and offset_age_s <= 0.5:
        is_held = state is TrackerState.HOLDING or validity is Validity.HELD
        return Indication.HOLDING if is_held else Indication.TRACKING
    if state is TrackerState.SEARCHING and command is Command.SEARCH:
        return Indication.SEARCHING
    # A robot that is lost while it commands TRACK leaves the tracker disarmed.
    is_wanted = is_following or command in (Command.TRACK, Command.HOLD)
    return Indication.NO_OFFSETS if is_wanted else Indication.DISARMED


def headline(
    state: TrackerState,
    fault: Fault,
    reason: GateReason,
    indication: Indication | None = None,
    is_too_busy: bool = False,
) -> str:
    """Return why the tracker is as it is, in one or two sentences."""
    if state is TrackerState.FAULT and fault is not Fault.NONE:
        return FAULTS[fault]
    if indication is Indication.NO_OFFSETS and reason is GateReason.NONE:
        return NOTHING_SENT
    if state is TrackerState.DISARMED and reason is GateReason.NOT_ARMED:
        return NO_DISARM if indication is Indication.NO_OFFSETS else STATES[state]
    if is_too_busy and reason in DELAYS:
        return TOO_BUSY
    return REASONS[reason] or STATES[state]


def plain(name: str) -> str:
    """Return an enumeration's name as a person reads it."""
    return name.lower().replace("_", " ")
