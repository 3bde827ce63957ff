"""RTDE of protocol version 2, as a client of the controller (UniversalRobots/RTDE_Python_Client_Library).

The robot's program states its word in an output register, and applies what it finds in the input registers.
A register keeps its last value, so one counts the answers: `rtde_set_watchdog` watches it.
"""

import math
import struct

from scipy.spatial.transform import Rotation

from robot_io.ports.report import Dialect, PortCorrection, PortError, PortReport, ProgramWord

VERSION = 2
RATE_HZ = 125.0
"""Rate of reports: the bus of arctrack takes a pose each 10 ms."""

MAX_BYTES = 4096
"""Largest package; those of the setup name a few variables."""

OUTPUTS = {
    "timestamp": "DOUBLE",
    "actual_TCP_pose": "VECTOR6D",
    "runtime_state": "UINT32",
    "safety_status_bits": "UINT32",
    "output_int_register_24": "INT32",
}
"""Outputs that the controller is asked to send, and their types."""

INPUTS = {
    "input_double_register_24": "DOUBLE",
    "input_double_register_25": "DOUBLE",
    "input_int_register_24": "INT32",
    "input_int_register_25": "INT32",
}
"""Inputs that it gets: y and z, m; whether they count; the number of the answer."""

PLAYING = 2
"""runtime_state of a program that runs."""

STOPPED_BITS = 0b111_1111_0100
"""Safety bits of a stop: protective, safeguard, emergency, violation, fault."""

_REPORT = struct.Struct(">d6dIIi")
_ANSWER = struct.Struct(">BddiI")
_HEADER = struct.Struct(">HB")


class RtdeDialect(Dialect):
    """A client of RTDE: version, outputs, inputs, start; then reports and their answers."""

    def __init__(self) -> None:
        self._rest = b""
        self._expected = b"V"
        self._outputs_recipe = self._inputs_recipe = 0
        self._count = 0

    def greeting(self) -> bytes:
        """Return the request for the protocol's version."""
        return _package(b"V", struct.pack(">H", VERSION))

    def hear(self, data: bytes) -> tuple[list[PortReport], bytes]:
        """Return the reports of whole packages, and the next request of the setup."""
        self._rest += data
        reports, reply = [], b""
        while len(self._rest) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._rest)
            name = bytes([kind])
            if not _HEADER.size <= size <= MAX_BYTES or name not in (b"M", self._expected):
                raise PortError(f"a package {name!r} of {size} bytes where {self._expected!r} is due")
            if len(self._rest) < size:
                break
            payload, self._rest = self._rest[_HEADER.size : size], self._rest[size:]
            if name == b"M":
                continue
            if name == b"U":
                reports.append(self._report(payload))
            else:
                reply += self._next_request(name, payload)
        return reports, reply

    def answer(self, report: PortReport, correction: PortCorrection) -> bytes:
        """Return the input registers; where nothing counts the displacement stays, and its flag is 0."""
        self._count = (self._count + 1) % 2**31
        y_m, z_m = correction.y_mm / 1000.0, correction.z_mm / 1000.0
        return _package(b"U", _ANSWER.pack(self._inputs_recipe, y_m, z_m, correction.is_usable, self._count))

    def _next_request(self, name: bytes, payload: bytes) -> bytes:
        if name in (b"V", b"S"):
            if payload[:1] != b"\x01":
                raise PortError(f"the controller refuses {'version 2' if name == b'V' else 'to start'}")
            self._expected = b"O" if name == b"V" else b"U"
            outputs = struct.pack(">d", RATE_HZ) + ",".join(OUTPUTS).encode()
            return _package(b"O", outputs) if name == b"V" else b""
        if not payload:
            raise PortError("a reply to a setup that is empty")
        variables = OUTPUTS if name == b"O" else INPUTS
        types = payload[1:].decode("ascii", "replace").split(",")
        for (variable, kind), type_there in zip(variables.items(), types, strict=False):
            if type_there != kind:
                raise PortError(f"{variable}: the controller says {type_there}; {kind} is needed")
        if len(types) != len(variables):
            raise PortError("the controller's types are not as many as the variables")
        if name == b"O":
            self._outputs_recipe, self._expected = payload[0], b"I"
            return _package(b"I", ",".join(INPUTS).encode())
        self._inputs_recipe, self._expected = payload[0], b"S"
        return _package(b"S", b"")

    def _report(self, payload: bytes) -> PortReport:
        if len(payload) != 1 + _REPORT.size or payload[0] != self._outputs_recipe:
            raise PortError("a package of data of another recipe")
        time_s, x, y, z, rx, ry, rz, runtime, safety, number = _REPORT.unpack(payload[1:])
        if not math.isfinite(time_s):
            raise PortError("a time that is not finite")
        word = ProgramWord(number & 0xFFFF_FFFF)
        qx, qy, qz, qw = Rotation.from_rotvec((rx, ry, rz)).as_quat().tolist()
        return word.report(
            stamp=0,
            robot_time_s=time_s,
            position_base_mm=(1000.0 * x, 1000.0 * y, 1000.0 * z),
            quaternion_xyzw=(qx, qy, qz, qw),
            is_running=runtime == PLAYING,
            is_stopped=bool(safety & STOPPED_BITS),
        )


def _package(name: bytes, payload: bytes) -> bytes:
    return _HEADER.pack(_HEADER.size + len(payload), name[0]) + payload
