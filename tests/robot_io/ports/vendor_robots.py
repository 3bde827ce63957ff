"""Robots of four makes, written from their published message layouts and from no codec of ours.

EGM: egm.proto of ros-industrial/abb_libegm, with RAPIDfromRobot = 13 of RobotWare 7. RSI: the examples of
kuka_experimental. RTDE: UniversalRobots/RTDE_Python_Client_Library. The open stream:
docs/how_to/robot_tcp_json.md.

`report` returns the bytes of a report, `read` what an answer says: the displacement (y, z), mm, that the
robot then applies, and whether it counts.
"""

from __future__ import annotations

import json
import math
import re
import struct
from dataclasses import dataclass, field

from scipy.spatial.transform import Rotation


@dataclass
class Said:
    """What a robot's program and controller say; all numbers in mm and s."""

    time_s: float = 0.0
    place_mm: tuple[float, float, float] = (100.0, -20.0, 300.0)
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    command: int = 0
    laser: bool = True
    correction: bool = True
    arc: bool = True
    moving: bool = True
    automatic: bool = True
    stopped: bool = False
    job: int = 1

    @property
    def word(self) -> int:
        bits = (self.laser, self.correction, self.arc, self.moving, self.automatic, not self.stopped)
        return self.command | sum(bit << n for n, bit in enumerate(bits, 3)) | self.job << 16


Answers = list[tuple[float, float, bool]]


def tagged(number: int, kind: int, held: bytes) -> bytes:
    return bytes([number << 3 | kind]) + held


def varint(number: int) -> bytes:
    septets = [number >> shift & 127 for shift in range(0, max(number.bit_length(), 1), 7)]
    return bytes([s | 128 for s in septets[:-1]] + [septets[-1]])


def message(number: int, held: bytes) -> bytes:
    return tagged(number, 2, varint(len(held)) + held)


def doubles(*values: float) -> bytes:
    return b"".join(tagged(n, 1, struct.pack("<d", value)) for n, value in enumerate(values, 1))


@dataclass
class AbbRobot:
    """EGM path correction."""

    cycle_s = 0.004
    seqno: int = 0
    has_word: bool = True

    def report(self, said: Said) -> bytes:
        self.seqno += 1
        x, y, z, w = said.quaternion
        header = tagged(1, 0, varint(self.seqno)) + tagged(2, 0, varint(round(1000 * said.time_s)))
        pose = message(1, doubles(*said.place_mm)) + message(2, doubles(w, x, y, z))
        clock = tagged(1, 0, varint(1_764_000_000)) + tagged(2, 0, varint(123_456))
        feedback = message(1, b"".join(tagged(1, 1, struct.pack("<d", 0.5 * n)) for n in range(6)))
        feedback += message(2, pose) + message(4, clock)
        state = message(4, tagged(1, 0, b"\1" if not said.stopped else b"\2")) + message(
            5, tagged(1, 0, b"\3")
        )
        word = tagged(1, 0, b"\1") + tagged(2, 1, struct.pack("<d", said.word))
        return (
            message(1, header + tagged(3, 0, b"\2"))
            + message(2, feedback)
            + message(3, message(2, pose))
            + state
            + tagged(6, 0, b"\0")
            + message(8, tagged(1, 0, b"\2"))
            + tagged(10, 1, struct.pack("<d", 12.0))
            + (message(13, word) if self.has_word else b"")
        )

    def read(self, answer: bytes) -> Answers:
        if not answer:
            return []
        # Header: seqno, tm, mtype 4; then pos and age; the lengths are read, the layout is fixed.
        assert answer[0] == 0x0A
        header, rest = answer[2 : 2 + answer[1]], answer[2 + answer[1] :]
        assert header.endswith(b"\x18\x04")
        assert rest[0] == 0x12
        assert rest[1] == len(rest) - 2
        place, age = rest[4 : 4 + rest[3]], rest[4 + rest[3] :]
        assert (rest[2], len(place), age[0]) == (0x0A, 27, 0x10)
        assert place[0:1] + place[9:10] + place[18:19] == b"\x09\x11\x19"
        x, y, z = (struct.unpack("<d", place[n + 1 : n + 9])[0] for n in (0, 9, 18))
        assert x == 0.0
        return [(y, z, True)]


@dataclass
class KukaRobot:
    """RSI: POSCORR applies what RKorr holds, whether or not it counts."""

    cycle_s = 0.004

    def report(self, said: Said) -> bytes:
        x, y, z = said.place_mm
        a, b, c = Rotation.from_quat(said.quaternion).as_euler("ZYX", degrees=True)
        place = f'X="{x:.4f}" Y="{y:.4f}" Z="{z:.4f}" A="{a:.4f}" B="{b:.4f}" C="{c:.4f}"'
        return (
            f'<Rob TYPE="KUKA"><RIst {place}/><RSol {place}/><Delay D="0"/><Word>{said.word}</Word>'
            f"<IPOC>{1000 * said.time_s:.0f}</IPOC></Rob>"
        ).encode()

    def read(self, answer: bytes) -> Answers:
        said = re.fullmatch(
            r'<Sen Type="ImFree"><RKorr X="0.0000" Y="([-.\d]+)" Z="([-.\d]+)" A="0.0000" B="0.0000" '
            r'C="0.0000"/><Usable>([01])</Usable><IPOC>(\d+)</IPOC></Sen>',
            answer.decode(),
        )
        assert said is not None, answer
        self.ipoc = int(said[4])
        return [(float(said[1]), float(said[2]), said[3] == "1")]


@dataclass
class UrRobot:
    """RTDE: the controller's side; its program applies the registers while their flag is 1."""

    cycle_s = 0.008
    rest: bytes = b""
    started: bool = False
    counts: list[int] = field(default_factory=list)

    def report(self, said: Said) -> bytes:
        place = [value / 1000.0 for value in said.place_mm]
        turn = Rotation.from_quat(said.quaternion).as_rotvec()
        word = said.word if said.word < 2**31 else said.word - 2**32
        payload = b"\1" + struct.pack(">d6d", said.time_s, *place, *turn)
        return package("U", payload + struct.pack(">IIi", 2, 0x80 if said.stopped else 1, word))

    def hear(self, data: bytes) -> tuple[bytes, Answers]:
        """Answer the client's setup, and return its inputs."""
        self.rest += data
        reply, answers = b"", []
        while len(self.rest) >= 3 and len(self.rest) >= (size := int.from_bytes(self.rest[:2], "big")):
            kind, payload, self.rest = chr(self.rest[2]), self.rest[3:size], self.rest[size:]
            if kind == "V":
                reply += package("V", b"\1" if payload == b"\0\2" else b"\0")
            elif kind == "O":
                assert struct.unpack(">d", payload[:8]) == (125.0,)
                types = {
                    "timestamp": "DOUBLE",
                    "actual_TCP_pose": "VECTOR6D",
                    "output_int_register_24": "INT32",
                }
                names = payload[8:].decode().split(",")
                reply += package("O", b"\1" + ",".join(types.get(n, "UINT32") for n in names).encode())
            elif kind == "I":
                names = payload.decode().split(",")
                reply += package(
                    "I", b"\7" + ",".join("DOUBLE" if "double" in n else "INT32" for n in names).encode()
                )
            elif kind == "S":
                self.started = True
                reply += package("S", b"\1")
            else:
                assert (kind, payload[0]) == ("U", 7)
                y_m, z_m, usable, count = struct.unpack(">ddii", payload[1:])
                self.counts.append(count)
                answers.append((1000.0 * y_m, 1000.0 * z_m, usable == 1))
        return reply, answers

    def read(self, answer: bytes) -> Answers:
        return self.hear(answer)[1]


def package(kind: str, payload: bytes) -> bytes:
    return struct.pack(">HB", 3 + len(payload), ord(kind)) + payload


@dataclass
class JsonRobot:
    """The open stream."""

    cycle_s = 0.010
    seq: int = 0
    rest: bytes = b""
    hello = b'{"hello": "arctrack", "version": 1}\n'

    def report(self, said: Said) -> bytes:
        self.seq += 1
        on = {True: "ON", False: "OFF"}
        return (
            json.dumps(
                {
                    "seq": self.seq,
                    "time_us": round(1e6 * said.time_s),
                    "position_mm": said.place_mm,
                    "quaternion_xyzw": said.quaternion,
                    "mode": "AUTOMATIC" if said.automatic else "MANUAL",
                    "motion": "MOVING" if said.moving else "STOPPED",
                    "welding": "WELDING" if said.arc else "OFF",
                    "arc": on[said.arc],
                    "emergency_stop": on[said.stopped],
                    "correction": on[said.correction],
                    "command": ["DISARM", "ARM", "RESET", "SEARCH", "TRACK", "HOLD", "STORE_ZERO", "FIND"][
                        said.command
                    ],
                    "laser": on[said.laser],
                    "job": said.job,
                }
            ).encode()
            + b"\n"
        )

    def read(self, answer: bytes) -> Answers:
        *lines, self.rest = (self.rest + answer).split(b"\n")
        said = [json.loads(line) for line in lines]
        return [
            (s["y_mm"], s["z_mm"], True) if s["usable"] else (math.nan, math.nan, False)
            for s in said
            if "usable" in s
        ]


ROBOTS = {"tcp_json": JsonRobot, "egm": AbbRobot, "rsi": KukaRobot, "rtde": UrRobot}
