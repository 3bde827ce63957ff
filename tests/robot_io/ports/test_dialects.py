"""Each dialect against its vendor's robot: what is said arrives, and nothing else does."""

from __future__ import annotations

import itertools
import json
import math
import re
import struct
from dataclasses import asdict, replace
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from port_cell import DIALECTS, connected
from vendor_robots import ROBOTS, Said, message, package, tagged, varint

from arctrack.control.cell_file.choices import PORT_NAMES
from robot_io import (
    BusMessage,
    Command,
    FindRefusal,
    FindResult,
    FoundPosition,
    FoundRotation,
    GateReason,
    MotionState,
    Protector,
    RobotMode,
    Switch,
    TrackerCommand,
    TrackerState,
    decode,
)
from robot_io.ports.egm.dialect import EgmDialect
from robot_io.ports.port import PORTS, address_of
from robot_io.ports.report import PortCorrection, PortError, ProgramWord
from robot_io.ports.rsi.dialect import RsiDialect
from robot_io.ports.rtde.dialect import RtdeDialect
from robot_io.ports.session import RobotSession
from robot_io.ports.tcp_json.dialect import JsonDialect

each_interface = pytest.mark.parametrize("interface", ROBOTS)
COUNTS = PortCorrection(1.2345, -0.5678, True, 33.0, TrackerState.TRACKING, GateReason.NONE)
millimetres = st.floats(-1600.0, 1600.0).map(lambda value: round(value, 3))
turns = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
said = st.builds(
    Said,
    time_s=st.integers(1, 10**9).map(lambda n: n / 1000.0),
    place_mm=st.tuples(*[millimetres] * 3),
    quaternion=turns.map(lambda q: tuple((np.array(q) / np.linalg.norm(q)).tolist())),
    command=st.integers(0, 6),
    job=st.integers(0, 65_534),
    **{name: st.booleans() for name in ("laser", "correction", "arc", "moving", "automatic", "stopped")},
)


@each_interface
@given(said)
def test_a_report_arrives_as_it_was_said(interface: str, said: Said) -> None:
    robot, dialect = connected(interface)
    ((report,), reply) = dialect.hear(robot.report(said))
    assert reply == b""
    assert report.robot_time_s == pytest.approx(said.time_s, abs=1e-6)
    assert report.position_base_mm == pytest.approx(said.place_mm, abs=1e-4)
    assert abs(np.dot(report.quaternion_xyzw, said.quaternion)) == pytest.approx(1.0, abs=1e-9)
    assert report.command is Command(said.command)
    assert report.job_number == said.job
    assert (report.laser is Switch.ON) == said.laser
    status = report.status
    assert (status.arc is Switch.ON) == said.arc
    assert (status.correction is Switch.ON) == said.correction
    assert (status.motion is MotionState.MOVING) == said.moving
    assert (status.mode is RobotMode.AUTOMATIC) == said.automatic
    assert (status.emergency_stop is Switch.ON) == said.stopped


@each_interface
@given(st.floats(-10.0, 10.0), st.floats(-10.0, 10.0))
def test_an_answer_arrives_as_it_was_given(interface: str, y_mm: float, z_mm: float) -> None:
    robot, dialect = connected(interface)
    said = Said(time_s=77.004)
    ((report,), _) = dialect.hear(robot.report(said))
    ((y_read_mm, z_read_mm, counts),) = robot.read(
        dialect.answer(report, replace(COUNTS, y_mm=y_mm, z_mm=z_mm))
    )
    assert (y_read_mm, z_read_mm) == pytest.approx((y_mm, z_mm), abs=1e-4)
    assert counts
    if interface == "rsi":
        assert robot.ipoc == 77_004


@each_interface
def test_what_does_not_count_is_said_not_to_or_not_at_all(interface: str) -> None:
    robot, dialect = connected(interface)
    ((report,), _) = dialect.hear(robot.report(Said(time_s=1.0)))
    answers = robot.read(dialect.answer(report, replace(COUNTS, is_usable=False, age_ms=float("nan"))))
    assert [counts for *_, counts in answers] == ([] if interface == "egm" else [False])


@each_interface
@given(st.data())
def test_damage_is_refused_and_nothing_else_happens(interface: str, data) -> None:
    robot, dialect = connected(interface)
    sent = bytearray(robot.report(Said(time_s=9.0)))
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(sent)))
        sent[place : place + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    try:
        reports, _ = dialect.hear(bytes(sent))
    except PortError:
        return
    for report in reports:
        assert np.isfinite([report.robot_time_s, *report.position_base_mm]).all()
        assert np.linalg.norm(report.quaternion_xyzw) == pytest.approx(1.0, abs=1.1e-3)


@each_interface
@given(st.binary(max_size=300))
def test_garbage_is_refused(interface: str, data: bytes) -> None:
    dialect = DIALECTS[interface]()
    try:
        reports, _ = dialect.hear(data)
    except PortError:
        return
    assert reports == []


@pytest.mark.parametrize("interface", ["tcp_json", "rtde"])
@given(st.data())
def test_a_stream_may_be_cut_anywhere(interface: str, data) -> None:
    robot, dialect = connected(interface)
    times_s = [1.0, 1.01, 1.02]
    sent = b"".join(robot.report(Said(time_s=time_s)) for time_s in times_s)
    cuts = sorted({0, len(sent), *data.draw(st.lists(st.integers(0, len(sent)), max_size=8))})
    reports = [r for a, b in itertools.pairwise(cuts) for r in dialect.hear(sent[a:b])[0]]
    assert [report.robot_time_s for report in reports] == pytest.approx(times_s)


def test_another_version_is_refused() -> None:
    with pytest.raises(PortError, match="hello of version 1"):
        JsonDialect().hear(b'{"hello": "arctrack", "version": 2}\n')
    rtde = RtdeDialect()
    assert rtde.greeting() == package("V", b"\0\2")
    with pytest.raises(PortError, match="refuses version 2"):
        rtde.hear(package("V", b"\0"))
    with pytest.raises(PortError, match="Rob"):
        RsiDialect().hear(b'<Rob TYPE="KUKA2"/>')
    header = tagged(1, 0, varint(1)) + tagged(2, 0, varint(2)) + tagged(3, 0, b"\4")
    with pytest.raises(PortError, match="MSGTYPE_DATA"):
        EgmDialect().hear(message(1, header))
    with pytest.raises(PortError, match="bits 9 to 15"):
        ProgramWord(0x200)


def test_a_stream_says_what_is_wrong_with_a_line() -> None:
    robot, dialect = connected("tcp_json")
    right = json.loads(robot.report(Said()))
    for change, named in (
        ({"arc": "BURNING"}, "'BURNING': must be one of OFF, ON, UNKNOWN"),
        ({"seq": 1.5}, "1.5: must be a whole number"),
        ({"position_mm": [0.0, 0.0]}, "values to unpack"),
        ({"position_mm": [0.0, 0.0, float("nan")]}, "not finite"),
        ({"quaternion_xyzw": [1, 1, 1, 1]}, "norm is not 1"),
        ({"job": 65_535}, "from 0 to 65534"),
    ):
        with pytest.raises(PortError, match=named):
            dialect.hear(json.dumps(right | change).encode() + b"\n")
    del right["command"]
    with pytest.raises(PortError, match="a report without 'command'"):
        dialect.hear(json.dumps(right).encode() + b"\n")
    with pytest.raises(PortError, match="more than 4096 bytes"):
        dialect.hear(b" " * 5000)


def test_a_sequence_must_not_repeat_or_jump() -> None:
    for step in (-1, 0, 2):
        robot, dialect = connected("tcp_json")
        dialect.hear(robot.report(Said()))
        robot.seq += step - 1
        with pytest.raises(PortError, match="must be one more"):
            dialect.hear(robot.report(Said(time_s=1.0)))


def test_rsi_takes_no_declarations() -> None:
    bomb = (
        b'<!DOCTYPE Rob [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><Rob TYPE="KUKA"><IPOC>&b;</IPOC></Rob>'
    )
    with pytest.raises(PortError, match="XML that RSI does not send"):
        RsiDialect().hear(bomb)
    with pytest.raises(PortError, match="XML that RSI does not send"):
        RsiDialect().hear(bomb.decode().encode("utf-16"))


def test_egm_without_a_word_says_what_the_cell_file_states() -> None:
    robot = ROBOTS["egm"](has_word=False)
    stated = Said(command=int(Command.TRACK))
    ((report,), _) = EgmDialect().hear(robot.report(stated))
    assert (report.command, report.status.arc) == (Command.DISARM, Switch.OFF)
    ((report,), _) = EgmDialect(stated.word).hear(robot.report(stated))
    assert (report.command, report.status.arc, report.job_number) == (Command.TRACK, Switch.ON, 1)
    stopped = robot.report(stated).replace(message(8, tagged(1, 0, b"\2")), message(8, tagged(1, 0, b"\1")))
    ((report,), _) = EgmDialect(stated.word).hear(stopped)
    assert (report.command, report.status.motion) == (Command.DISARM, MotionState.STOPPED)


def test_rtde_names_a_register_that_is_not_there() -> None:
    rtde = RtdeDialect()
    rtde.hear(package("V", b"\1"))
    with pytest.raises(PortError, match="runtime_state: the controller says NOT_FOUND"):
        rtde.hear(package("O", b"\1DOUBLE,VECTOR6D,NOT_FOUND,UINT32,INT32"))


def test_rtde_counts_its_answers_and_takes_text() -> None:
    robot, dialect = connected("rtde")
    for n in (1, 2, 3):
        ((report,), _) = dialect.hear(package("M", b"\5hello\0\0") + robot.report(Said(time_s=float(n))))
        robot.read(dialect.answer(report, COUNTS))
    assert robot.counts == [1, 2, 3]
    stopped = robot.report(Said()).replace(struct.pack(">II", 2, 1), struct.pack(">II", 4, 1))
    assert dialect.hear(stopped)[0][0].status.correction is Switch.OFF


def test_a_cell_file_takes_every_port():
    assert PORTS.keys() == set(PORT_NAMES)


def test_an_address_is_checked() -> None:
    assert address_of("rsi", "0.0.0.0") == ("0.0.0.0", PORTS["rsi"].network_port)
    assert address_of("rtde", "192.168.0.7:30004") == ("192.168.0.7", 30_004)
    for channel in ("", ":1", "host:", "host:x", "host:70000"):
        with pytest.raises(PortError, match="HOST or HOST:PORT"):
            address_of("egm", channel)


def test_a_word_of_nothing_allows_nothing() -> None:
    report = ProgramWord(0).report(0, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    assert (report.command, report.laser, report.job_number) == (Command.DISARM, Switch.OFF, 0)
    allowed = {Switch.ON, MotionState.MOVING, RobotMode.AUTOMATIC}
    status = asdict(report.status)
    assert status.pop("emergency_stop") is Switch.ON
    assert not allowed & set(status.values())


def test_the_page_has_the_words_bits() -> None:
    page = (Path(__file__).parents[3] / "docs" / "reference" / "ports.md").read_text()
    bits = {int(n): text for n, text in re.findall(r"^\| (\d+) \| (.*) \|$", page, re.M)}
    for name, text in {
        "laser": "laser",
        "correction": "corrections",
        "arc": "arc",
        "moving": "moves",
        "automatic": "automatic",
    }.items():
        others = Said(laser=False, correction=False, arc=False, moving=False, automatic=False, stopped=True)
        (bit,) = (n for n in bits if replace(others, job=0, **{name: True}).word == 1 << n)
        assert text in bits[bit]
    for job, command in ((66044, 4), (66008, 0)):
        assert str(job) in page
        assert replace(Said(), command=command, arc=command != 0).word == job


def test_a_find_is_asked_and_answered_over_the_stream_alone() -> None:
    (robot, dialect), session, tracker = connected("tcp_json"), RobotSession(), Protector()
    number, now_s = -1, 100.0

    def answered(command: Command, *heard: BusMessage) -> dict:
        """Return the answer to a report, the tracker having sent messages behind it."""
        nonlocal now_s, number
        now_s += 0.2
        ((report,), _) = dialect.hear(robot.report(Said(time_s=now_s, command=command)))
        for arbitration_id, data in session.take(report, now_s):
            sent = decode(arbitration_id, data)
            number = sent.request_number if isinstance(sent, TrackerCommand) else number
        for message_heard in heard:
            arbitration_id, data = tracker.protect(message_heard)
            frame = can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False)
            session.hear(frame, now_s, 0.0)
        return json.loads(dialect.answer(report, session.correction(report, now_s)))

    assert "find" not in answered(Command.DISARM)
    assert answered(Command.FIND)["find"] is None
    rotation = FoundRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), math.nan, 0.2)
    result = FindResult(number, FindRefusal.NONE, 0.5, math.nan, 0.14, 0.34, False)
    messages = (result, FoundPosition(65.425, 0.1, -3.725), rotation)
    told = answered(Command.FIND, *messages)["find"]
    assert told["refusal"] == "NONE"
    assert told["position_mm"] == pytest.approx([65.425, 0.1, -3.725])
    assert told["quaternion_xyzw"] == [0.0, 0.0, 0.0, 1.0]
    assert told["sigma_z_mm"] == pytest.approx(0.34)
    assert told["mismatch_mm"] is told["direction_sigma_deg"] is None
    assert answered(Command.FIND)["find"] == told
    # Another command ends it; the next FIND is another request, which an old answer is none to.
    assert "find" not in answered(Command.DISARM)
    assert answered(Command.FIND, *messages)["find"] is None
    for word in (Said(command=7).word, 7):
        with pytest.raises(PortError, match="other than FIND"):
            ProgramWord(word)
