"""Lines of JSON: the robot's hello, then a report in each cycle and its answer."""

import json
import math
from enum import IntEnum
from typing import Any, TypeVar

from robot_io.find_answer import FindAnswer
from robot_io.ports.report import Dialect, PortCorrection, PortError, PortReport
from robot_io.protocol.messages import Command, MotionState, RobotMode, RobotStatus, Switch, WeldingState

VERSION = 1
"""Version of the layout, which both sides state in their hello."""

MAX_LINE_BYTES = 4096
"""Longest line; a report has some 500 bytes."""

E = TypeVar("E", bound=IntEnum)


class JsonDialect(Dialect):
    """The open stream's side of arctrack. A report's `seq` is one more than that of the one before."""

    def __init__(self) -> None:
        self._rest = b""
        self._has_greeted = False
        self._seq: int | None = None

    def hear(self, data: bytes) -> tuple[list[PortReport], bytes]:
        """Return the reports of whole lines, and the answer to a hello."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if max(map(len, (self._rest, *lines))) > MAX_LINE_BYTES:
            raise PortError(f"a line of more than {MAX_LINE_BYTES} bytes")
        reports, reply = [], b""
        for line in lines:
            said = _parsed(line)
            if self._has_greeted:
                reports.append(self._report(said))
                continue
            if said.get("hello") != "arctrack" or said.get("version") != VERSION:
                raise PortError(f"the first line must be a hello of version {VERSION}")
            self._has_greeted = True
            reply = _line({"hello": "arctrack", "version": VERSION})
        return reports, reply

    def answer(self, report: PortReport, correction: PortCorrection) -> bytes:
        """Return the line that answers a report; offsets that do not count are null.

        Under FIND it has the joint, null until the tracker has answered.
        """
        usable = correction.is_usable
        find = {"find": _found(correction.find)} if report.command is Command.FIND else {}
        return _line(
            {
                "seq": report.stamp,
                "usable": usable,
                "y_mm": round(correction.y_mm, 4) if usable else None,
                "z_mm": round(correction.z_mm, 4) if usable else None,
                "age_ms": round(correction.age_ms, 1) if usable else None,
                "state": correction.state.name,
                "reason": correction.reason.name,
                **find,
            }
        )

    def _report(self, said: dict[str, Any]) -> PortReport:
        try:
            seq = _whole(said["seq"])
            status = RobotStatus(
                mode=_member(RobotMode, said["mode"]),
                motion=_member(MotionState, said["motion"]),
                welding=_member(WeldingState, said["welding"]),
                arc=_member(Switch, said["arc"]),
                emergency_stop=_member(Switch, said["emergency_stop"]),
                correction=_member(Switch, said["correction"]),
                weave=Switch.UNKNOWN,
                current_a=_optional(said.get("current_a"), 819.0),
                travel_speed_mm_s=_optional(said.get("travel_speed_mm_s"), 204.0),
                path_section=None,
            )
            x_mm, y_mm, z_mm = map(_number, said["position_mm"])
            qx, qy, qz, qw = map(_number, said["quaternion_xyzw"])
            job = said.get("job")
            report = PortReport(
                stamp=seq,
                robot_time_s=_whole(said["time_us"]) / 1e6,
                position_base_mm=(x_mm, y_mm, z_mm),
                quaternion_xyzw=(qx, qy, qz, qw),
                status=status,
                command=_member(Command, said["command"]),
                laser=_member(Switch, said["laser"]),
                job_number=None if job is None else _whole(job, 65_534),
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise PortError(
                f"a report without {error}" if isinstance(error, KeyError) else f"{error}"
            ) from None
        if self._seq is not None and seq != self._seq + 1:
            raise PortError(f"seq {seq} after {self._seq}: must be one more")
        self._seq = seq
        return report


def _parsed(line: bytes) -> dict[str, Any]:
    try:
        said = json.loads(line)
    except (ValueError, RecursionError):
        raise PortError("a line that is no JSON") from None
    if not isinstance(said, dict):
        raise PortError("a line that is no object")
    return said


def _found(find: FindAnswer | None) -> dict[str, object] | None:
    """Return an answer to a FIND as the stream says it: what is not known is null."""
    if find is None:
        return None
    result, position, rotation = find.result, find.position, find.rotation
    return {
        "refusal": result.refusal.name,
        "position_mm": _all_known(position.x_mm, position.y_mm, position.z_mm),
        "quaternion_xyzw": _all_known(*rotation.quaternion_xyzw),
        "sigma_y_mm": _known(result.sigma_y_mm),
        "sigma_z_mm": _known(result.sigma_z_mm),
        "direction_sigma_deg": _known(rotation.direction_sigma_deg),
        "normal_sigma_deg": _known(rotation.normal_sigma_deg),
        "gap_mm": _known(result.gap_mm),
        "mismatch_mm": _known(result.mismatch_mm),
        "joint_misfit": result.joint_misfit,
    }


def _known(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 5)


def _all_known(*values: float) -> list[float] | None:
    return None if any(map(math.isnan, values)) else [round(value, 5) for value in values]


def _line(said: dict[str, Any]) -> bytes:
    return json.dumps(said, separators=(",", ":")).encode() + b"\n"


def _member(kind: type[E], name: object) -> E:
    try:
        return kind[str(name)]
    except KeyError:
        raise PortError(f"{name!r}: must be one of {', '.join(kind.__members__)}") from None


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise PortError(f"{value!r}: must be a number")
    return float(value)


def _whole(value: object, upper: int = 2**53) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= upper:
        raise PortError(f"{value!r}: must be a whole number from 0 to {upper}")
    return value


def _optional(value: object, upper: float) -> float:
    """Return a number that may be missing; NaN where it is, or where the bus cannot carry it."""
    number = math.nan if value is None else _number(value)
    return number if 0.0 <= number <= upper else math.nan
