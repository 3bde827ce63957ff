"""Reports of a robot at its port, the answers to them, and the word in which a program says both."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

from robot_io.find_answer import FindAnswer
from robot_io.poses.nominal_path import Quaternion, Vector
from robot_io.protocol.messages import (
    Command,
    GateReason,
    MotionState,
    RobotMode,
    RobotStatus,
    Switch,
    TrackerState,
    WeldingState,
)


class PortError(ValueError):
    """Bytes that are no message of a port's protocol, or an address that cannot be used."""


@dataclass(frozen=True)
class PortReport:
    """A message of the robot.

    `stamp` is the robot's own number of the message, which an answer may have to repeat. `robot_time_s` is
    the robot's clock at the pose's sample; it rises from message to message. `position_base_mm` (3,) and
    `quaternion_xyzw` (4,) are the tool's in base. `command` is the program's, `laser` is ON where the program
    lets the laser be on, `job_number` the job that it names, or None.

    Raises PortError if a number is not finite, or the quaternion's norm is off 1 by more than 0.001.
    """

    stamp: int
    robot_time_s: float
    position_base_mm: Vector
    quaternion_xyzw: Quaternion
    status: RobotStatus
    command: Command
    laser: Switch
    job_number: int | None

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.robot_time_s, *self.position_base_mm))):
            raise PortError("a time or a coordinate is not finite")
        if not abs(math.hypot(*self.quaternion_xyzw) - 1.0) <= 1e-3:
            raise PortError(f"quaternion {self.quaternion_xyzw}: its norm is not 1")


@dataclass(frozen=True)
class PortCorrection:
    """Answer to a report.

    `y_mm` and `z_mm` are the displacement to be applied, mm in S, always finite: where `is_usable` is false
    it stays what it was. `age_ms` is the age of the capture behind it, NaN where none counts. `find` answers
    the program's FIND; None under another command, and until the answer is there.
    """

    y_mm: float
    z_mm: float
    is_usable: bool
    age_ms: float
    state: TrackerState
    reason: GateReason
    find: FindAnswer | None = None


class Dialect(ABC):
    """A vendor's protocol over one connection, without a socket or a clock."""

    def greeting(self) -> bytes:
        """Return what is sent as soon as a connection is there; empty where the robot speaks first."""
        return b""

    @abstractmethod
    def hear(self, data: bytes) -> tuple[list[PortReport], bytes]:
        """Return the reports in received bytes, and what is to be sent back at once.

        PortError for what is not of the protocol: a datagram is dropped, a connection closed.
        """

    @abstractmethod
    def answer(self, report: PortReport, correction: PortCorrection) -> bytes:
        """Return the answer to a report; empty for none."""


@dataclass(frozen=True)
class ProgramWord:
    """State of the robot's program in 32 bits: all 0 allows nothing.

    Bits 0 to 2 are the `Command`; then laser, correction, arc, moving, automatic, and emergency stop
    released; bits 16 to 31 are the job's number. PortError for a bit without a meaning, and for FIND, whose
    answer the protocols with such a word cannot carry.
    """

    word: int

    def __post_init__(self) -> None:
        if not 0 <= self.word < 2**32 or self.word & 0xFE00 or self.word & 7 == Command.FIND:
            raise PortError(
                f"program word {self.word:#x}: bits 9 to 15 must be 0, bits 0 to 2 a command other than FIND"
            )

    def report(
        self,
        stamp: int,
        robot_time_s: float,
        position_base_mm: Vector,
        quaternion_xyzw: Quaternion,
        is_running: bool = True,
        is_stopped: bool = False,
    ) -> PortReport:
        """Return the report of a pose with what the word says.

        What the controller itself says comes first: nothing moves or is corrected unless `is_running`, and
        `is_stopped` is an emergency stop.
        """
        arc, number = self._switch(5), self.word >> 16
        is_moving = is_running and self._switch(6) is Switch.ON
        status = RobotStatus(
            mode=RobotMode.AUTOMATIC if self._switch(7) is Switch.ON else RobotMode.MANUAL,
            motion=MotionState.MOVING if is_moving else MotionState.STOPPED,
            welding=WeldingState.WELDING if arc is Switch.ON else WeldingState.OFF,
            arc=arc,
            emergency_stop=Switch.ON if is_stopped or self._switch(8) is Switch.OFF else Switch.OFF,
            correction=self._switch(4) if is_running else Switch.OFF,
            weave=Switch.UNKNOWN,
            current_a=math.nan,
            travel_speed_mm_s=math.nan,
            path_section=None,
        )
        return PortReport(
            stamp,
            robot_time_s,
            position_base_mm,
            quaternion_xyzw,
            status,
            command=Command(self.word & 7),
            laser=self._switch(3),
            # All bits set name no job.
            job_number=None if number == 0xFFFF else number,
        )

    def _switch(self, bit: int) -> Switch:
        return Switch(self.word >> bit & 1)
