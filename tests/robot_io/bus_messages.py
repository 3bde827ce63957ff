"""Hypothesis strategies for the bus: any message of each type, and one plain example of each."""

from __future__ import annotations

import math
from enum import IntEnum
from typing import get_args, get_type_hints

from hypothesis import strategies as st

from robot_io.protocol.dbc import invalid_raw, message_layout
from robot_io.protocol.messages import (
    MESSAGE_TYPES,
    BusMessage,
    Command,
    DbcVersion,
    Fault,
    FindRefusal,
    FindResult,
    FoundPosition,
    FoundRotation,
    GateReason,
    JointType,
    LaserState,
    MotionState,
    PoseKind,
    RequestResult,
    RobotMode,
    RobotPosePosition,
    RobotPoseRotation,
    RobotPulse,
    RobotStatus,
    RobotSync,
    SeamGeometry,
    SeamOffset,
    SeamPoint,
    Source,
    Switch,
    TrackerCommand,
    TrackerHeartbeat,
    TrackerState,
    TrackerStatus,
    TrackerSyncEcho,
    Validity,
    WeldingState,
)

EXAMPLES: tuple[BusMessage, ...] = (
    RobotPosePosition(412.5, -88.025, 3.0, PoseKind.ACTUAL),
    RobotPoseRotation.from_quaternion((0.6, 0.0, -0.8, 0.0), 2.0),
    SeamOffset(0.123, -0.045, 12.0, 0.97, Validity.VALID),
    RobotStatus(
        RobotMode.AUTOMATIC,
        MotionState.MOVING,
        WeldingState.WELDING,
        Switch.ON,
        Switch.OFF,
        Switch.ON,
        Switch.OFF,
        120.0,
        2.5,
        4,
    ),
    TrackerCommand(Command.ARM, True, True, 7, 12, None, Switch.ON),
    SeamGeometry(0.4, -0.05, 0.012, math.nan, JointType.V_GROOVE),
    TrackerStatus(
        TrackerState.TRACKING,
        GateReason.NONE,
        False,
        False,
        False,
        True,
        False,
        True,
        False,
        False,
        1.02,
        0.95,
        3,
        12.25,
    ),
    DbcVersion(1, 0, 0, 0x57CDBC, Source.LIVE),
    SeamPoint(447.5, -88.0, math.nan),
    RobotSync(9, 12_345_678, None),
    TrackerSyncEcho(9, 1500, Source.LIVE),
    RobotPulse(20_000, 12_000, 3.4),
    FindResult(7, FindRefusal.NONE, 0.4, -0.06, 0.14, math.nan, False),
    FoundPosition(447.5, -88.0, math.nan),
    FoundRotation.from_quaternion((0.6, 0.0, -0.8, 0.0), math.nan, 0.2),
    TrackerHeartbeat(
        TrackerState.TRACKING, Source.LIVE, LaserState.ON, Fault.NONE, 7, RequestResult.DONE, 12, 200
    ),
)


def messages_of(message_type: type[BusMessage]) -> st.SearchStrategy[BusMessage]:
    hints = get_type_hints(message_type)
    layout = message_layout(message_type.__name__)
    fields = {name: _values(hint, layout.get_signal_by_name(name)) for name, hint in hints.items()}
    return st.builds(message_type, **fields)


def any_message() -> st.SearchStrategy[BusMessage]:
    return st.one_of([messages_of(message_type) for message_type in MESSAGE_TYPES])


def _values(hint, signal):
    kind = next((arm for arm in get_args(hint) if arm is not type(None)), hint)
    if kind is bool:
        return st.booleans()
    if issubclass(kind, IntEnum):
        return st.sampled_from(kind)
    if kind is float:
        known = st.floats(signal.minimum, signal.maximum)
        return known if invalid_raw(signal) is None else known | st.just(math.nan)
    known = st.integers(int(signal.minimum), int(signal.maximum))
    return known if invalid_raw(signal) is None else known | st.none()
