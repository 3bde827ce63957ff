r"""EgmRobot in, EgmSensorPathCorr out, by ABB's egm.proto (ros-industrial/abb_libegm, V1.1).

An EgmSensorPathCorr cannot say that it does not count. So where no offset counts nothing is sent, and EGM's
own \CommTimeout tells the program.
"""

from robot_io.ports.egm.wire import Value, field, fields, inner, real, values, whole
from robot_io.ports.report import PortCorrection, PortError, PortReport, ProgramWord

DATA, PATH_CORRECTION = 2, 4
"""EgmHeader.MessageType of the robot's messages and of ours."""

MOTORS_ON, MCI_RUNNING, RAPID_RUNNING = 1, 3, 2

HEADER, FEEDBACK, MOTORS, MCI, RAPID, FROM_RAPID = 1, 2, 4, 5, 8, 13
"""Fields of EgmRobot; RAPIDfromRobot is RobotWare 7's."""


class EgmDialect:
    """ABB's side of EGM path correction.

    The program's word is the first number of RAPIDfromRobot. `running_word` stands for it where a controller
    has no such message (RobotWare 6), while RAPID runs.
    """

    def __init__(self, running_word: int | None = None) -> None:
        self._running_word = None if running_word is None else ProgramWord(running_word)
        self._seqno = 0

    def greeting(self) -> bytes:
        """Return nothing: the robot speaks first."""
        return b""

    def hear(self, data: bytes) -> tuple[list[PortReport], bytes]:
        """Return the report of a datagram."""
        robot = values(data)
        header = inner(robot, HEADER)
        if whole(header, 3) != DATA:
            raise PortError("a header of another type than MSGTYPE_DATA")
        pose = inner(inner(robot, FEEDBACK), 2)
        position, orientation = inner(pose, 1), inner(pose, 2)
        w, x, y, z = (real(orientation, n) for n in (1, 2, 3, 4))
        is_executing = inner(robot, RAPID).get(1) == RAPID_RUNNING
        is_running = is_executing and inner(robot, MCI).get(1) == MCI_RUNNING
        word = self._word(robot, is_executing)
        report = PortReport(
            stamp=whole(header, 1),
            robot_time_s=whole(header, 2) / 1000.0,
            position_base_mm=(real(position, 1), real(position, 2), real(position, 3)),
            quaternion_xyzw=(x, y, z, w),
            status=word.status(is_running, is_stopped=inner(robot, MOTORS).get(1) != MOTORS_ON),
            command=word.command,
            laser=word.laser,
            job_number=word.job_number,
        )
        return [report], b""

    def answer(self, report: PortReport, correction: PortCorrection) -> bytes:
        """Return a path correction, or nothing where no offset counts."""
        if not correction.is_usable:
            return b""
        self._seqno = (self._seqno + 1) % 2**32
        header = (
            field(1, self._seqno) + field(2, round(1000.0 * report.robot_time_s)) + field(3, PATH_CORRECTION)
        )
        place = field(1, 0.0) + field(2, correction.y_mm) + field(3, correction.z_mm)
        return field(1, header) + field(2, field(1, place) + field(2, round(correction.age_ms)))

    def _word(self, robot: dict[int, Value], is_executing: bool) -> ProgramWord:
        held = robot.get(FROM_RAPID)
        if held is None:
            stated = self._running_word if is_executing else None
            return ProgramWord(0) if stated is None else stated
        if not isinstance(held, bytes):
            raise PortError("RAPIDfromRobot: must be a message")
        number = next((value for n, value in fields(held) if n == 2), None)
        if not (isinstance(number, float) and number.is_integer()):
            raise PortError("RAPIDfromRobot.dnum: the first must be the program's word, a whole number")
        return ProgramWord(int(number))
