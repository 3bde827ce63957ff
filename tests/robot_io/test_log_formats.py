"""Logs of the bus as others write them, cut, damaged and of several channels."""

from __future__ import annotations

import gzip
import re
import time
from datetime import datetime
from types import MappingProxyType

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robot_io.link.bus_log import BusLogError, BusLogWriter
from robot_io.link.bus_log_reader import AmbiguousChannelError, BusLogReader
from robot_io.link.inbox import SkipReason
from robot_io.poses.pose_assembler import PoseAssembler
from robot_io.protocol.messages import PoseKind, RobotPosePosition, RobotPoseRotation
from robot_io.protocol.protect import Protector

START_S = 1_714_557_599.5
ENGLISH = "date Wed May 01 09:59:59.500 am 2024\nbase hex  timestamps absolute\n"


def pose_frames(n_poses, channel="can0", y_mm=0.0):
    """Return the frames of a robot's poses, 10 ms apart."""
    protector, made = Protector(), []
    for n in range(n_poses):
        for message in (
            RobotPosePosition(0.1 * n, y_mm, 40.0, PoseKind.ACTUAL),
            RobotPoseRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), 0.0),
        ):
            identifier, payload = protector.protect(message)
            made.append(
                can.Message(
                    timestamp=START_S + 0.01 * n,
                    arbitration_id=identifier,
                    data=payload,
                    is_extended_id=False,
                    channel=channel,
                )
            )
    return made


def poses_in(path, channel=None):
    """Return the times and the x and y of the poses of a log, and the reader."""
    reader, assembler = BusLogReader(path, channel), PoseAssembler()
    samples = [sample for received in reader if (sample := assembler.push(received)) is not None]
    return [(s.timestamp_s, *s.position_base_mm[:2]) for s in samples], reader


def asc_text(head=ENGLISH, n_poses=3, names=MappingProxyType({})):
    """Return an `.asc` as Vector's tools write it, times since its date."""
    return head + "".join(
        f"   {frame.timestamp - START_S:.6f} 1  "
        f"{names.get(frame.arbitration_id, f'{frame.arbitration_id:x}')}             "
        f"Rx   d 8 {frame.data.hex(' ').upper()}\n"
        for frame in pose_frames(n_poses)
    )


@pytest.fixture
def utc(monkeypatch):
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


RELATIVE = """date Wed May 01 09:59:59.500 am 2024
base hex  timestamps relative
   0.000000 Start of measurement
   0.004000 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%
"""
FD_LINE = (
    "   {t:.6f} CANFD   1 Rx        {id:x}  {name} 0 0 8  8 {data}   130000  130  {flags} c7a10 0 0 0 0\n"
)


def fd_text(name, flags):
    return f"{ENGLISH}   0.000000 CANFD   Start of measurement\n" + "".join(
        FD_LINE.format(
            t=frame.timestamp - START_S,
            id=frame.arbitration_id,
            name=name,
            data=frame.data.hex(" "),
            flags=flags,
        )
        for frame in pose_frames(3)
    )


AT = "09:59:59.500 2024\nbase hex  timestamps absolute\n"
VECTOR = {
    "English": asc_text(),
    "24 hours": asc_text("date Wed May 1 " + AT),
    "March": asc_text("date Die Mär 5 " + AT),
    "German": asc_text("date Mit Mai 1 " + AT + "// Gerät: Schweißzelle 4\n"),
    "French": asc_text("date mer. mai 1 " + AT),
    "August": asc_text("date jeu. août 1 " + AT),
    "June": asc_text("date sam. juin 1 " + AT),
    "July": asc_text("date lun. juil. 1 " + AT),
    "Spanish": asc_text("date mié ene. 3 " + AT),
    "Italian": asc_text("date mer mag 1 " + AT),
    "Japanese": asc_text("date ? 5 1 " + AT),
    "ISO": asc_text("date 2024-05-01T09:59:59.500\nbase hex  timestamps absolute\n"),
    "names": asc_text(names={0x110: "RobotPosePosition", 0x111: "RobotPoseRotation"}),
    "classic frames of FD hardware": fd_text("", "0"),
    "with a name": fd_text("RobotPose", "0"),
}
DAYS = {
    "March": "2024-03-05",
    "August": "2024-08-01",
    "June": "2024-06-01",
    "July": "2024-07-01",
    "Spanish": "2024-01-03",
}


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8"])
@pytest.mark.parametrize("name", VECTOR)
def test_what_vectors_tools_write_is_read(tmp_path, utc, name, encoding):
    path = tmp_path / "can.asc"
    path.write_bytes(VECTOR[name].replace("\n", "\r\n").encode(encoding))
    start_s = datetime.fromisoformat(f"{DAYS.get(name, '2024-05-01')}T09:59:59.500").timestamp()
    poses, reader = poses_in(path)
    assert [x_mm for _, x_mm, _ in poses] == pytest.approx([0.0, 0.1, 0.2])
    assert [time_s for time_s, _, _ in poses] == pytest.approx(
        [start_s, start_s + 0.01, start_s + 0.02], abs=1e-6, rel=0.0
    )
    assert reader.damage is None
    assert not reader.skipped


def test_frames_of_can_fd_are_foreign(tmp_path):
    (tmp_path / "can.asc").write_text(fd_text("", "3000"))
    poses, reader = poses_in(tmp_path / "can.asc")
    assert not poses
    assert reader.skipped[SkipReason.FOREIGN] == 6


def test_relative_times_add_up_over_all_events(tmp_path, utc):
    lines = [
        f"   {step:.6f} 1  {frame.arbitration_id:x}             Rx   d 8 {frame.data.hex(' ')}\n"
        for step, frame in zip((0.006, 0.0, 0.01, 0.0), pose_frames(2), strict=True)
    ]
    path = tmp_path / "can.asc"
    path.write_text(RELATIVE + "".join(lines))
    times_s = [time_s for time_s, _, _ in poses_in(path)[0]]
    assert times_s == pytest.approx([1_714_557_599.51, 1_714_557_599.52], abs=1e-6, rel=0.0)
    # Where a line is lost, so is the time of all that follow.
    path.write_text(RELATIVE + "".join([*lines[:2], "   0.01 1  110   Rx   d 8 00\n", *lines[2:]]))
    poses, reader = poses_in(path)
    assert len(poses) == 1
    assert reader.damage == "line 7 cannot be read: it is left out"


def log_text(made):
    return "".join(
        f"({frame.timestamp:.6f}) {frame.channel} {frame.arbitration_id:03X}#{frame.data.hex().upper()}\n"
        for frame in made
    )


SCREEN = "".join(
    f" ({frame.timestamp:.6f})  can0  {frame.arbitration_id:03X}   [8]  {frame.data.hex(' ').upper()}\n"
    for frame in pose_frames(20)
)
TRC = ";$FILEVERSION=1.1\n;$STARTTIME=45413.4166608796\n;\n" + "".join(
    f"{n:6})  {1e3 * (frame.timestamp - START_S):10.1f}  Rx     "
    f"{frame.arbitration_id:04X}  8  {frame.data.hex(' ').upper()} \n"
    for n, frame in enumerate(pose_frames(20), 1)
)


WITH_WAY = re.sub(r"can0  ", "can0  RX - -  ", SCREEN)
STATES = ";$FILEVERSION=2.0\n;$STARTTIME=45413.4166608796\n;$COLUMNS=N,O,T,I,d,l,D\n" + "".join(
    f"{n:7} {1e3 * (frame.timestamp - START_S):13.3f} DT     {frame.arbitration_id:04X} Rx 8  "
    f"{frame.data.hex(' ').upper()}\n{n:7} 1.000 ST          Rx    00 00 00 08\n"
    for n, frame in enumerate(pose_frames(20), 1)
)


def written(path, made):
    """Write a log by python-can's own writer of its format."""
    with can.Logger(path) as log:
        for frame in made:
            log(frame)


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".csv", ".db", ".trc"])
def test_what_python_can_writes_is_read(tmp_path, utc, suffix):
    path = tmp_path / f"can{suffix}"
    written(path, pose_frames(5, channel=1))
    poses, reader = poses_in(path)
    assert [x_mm for _, x_mm, _ in poses] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert [poses[-1][0] - poses[0][0]] == pytest.approx([0.04], abs=1e-3)
    assert reader.damage is None


@pytest.mark.parametrize(
    ("suffix", "text"), [(".log", SCREEN), (".log", WITH_WAY), (".trc", TRC), (".trc", STATES)]
)
def test_what_candump_prints_and_peaks_tools_write_is_read(tmp_path, suffix, text):
    path = tmp_path / f"can{suffix}"
    path.write_text(text)
    poses, reader = poses_in(path)
    assert len(poses) == 20
    assert poses[-1] == pytest.approx((1_714_557_599.69, 1.9, 0.0), abs=1e-2, rel=0.0)
    assert reader.damage is None


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf"])
def test_two_robots_in_one_log_are_refused_until_one_is_named(tmp_path, suffix):
    path = tmp_path / f"can{suffix}"
    both = sorted(pose_frames(5, 0) + pose_frames(5, 1, y_mm=30.0), key=lambda frame: frame.timestamp)
    written(path, both)
    first, second = ("can0", "can1") if suffix == ".log" else ("1", "2")
    with pytest.raises(AmbiguousChannelError, match=f"channels {first} and {second} both carry RobotPose"):
        poses_in(path)
    assert {y_mm for _, _, y_mm in poses_in(path, first)[0]} == {0.0}
    assert {y_mm for _, _, y_mm in poses_in(path, second)[0]} == {30.0}
    assert len(poses_in(path, second)[0]) == 5
    with pytest.raises(BusLogError, match=f"has no frame of the channel 7; there are {first}, {second}"):
        poses_in(path, "7")


STEPS = re.sub(
    r"\([\d.]+\)(?=  can0  11(.))", lambda line: f"(000.{'009800' if line[1] == '0' else '000200'})", SCREEN
)
UNFIT = {
    "candump -td": (
        ".log",
        STEPS.encode(),
        "line 2: the time falls back to 0.000200, .* record by candump -L",
    ),
    "a .trc": (".log", TRC.encode(), "line 1 is none as candump -L"),
    "a .log": (".asc", SCREEN.encode(), "line 1 is none as Vector's tools"),
    "channels by name": (".asc", asc_text().replace(" 1  1", " CAN1  1").encode(), "line 3 is none"),
    "packed": (".asc", gzip.compress(asc_text().encode()), "is packed by gzip: unpack it"),
    "UTF-16": (".log", SCREEN.encode("utf-16"), "is UTF-16: save it as UTF-8"),
}


@pytest.mark.parametrize("name", UNFIT)
def test_a_log_of_another_kind_is_refused_with_a_cure(tmp_path, name):
    suffix, content, problem = UNFIT[name]
    path = tmp_path / f"can{suffix}"
    path.write_bytes(content)
    with pytest.raises(BusLogError, match=problem):
        poses_in(path)


def test_a_suffix_may_be_in_capitals(tmp_path, utc):
    (tmp_path / "RUN.ASC").write_text(asc_text())
    assert len(poses_in(tmp_path / "RUN.ASC")[0]) == 3


CUT = {".log": log_text(pose_frames(20)), ".asc": asc_text(n_poses=20), ".trc": TRC}


@pytest.mark.slow
@pytest.mark.parametrize("tail", [b"", bytes(300), bytes(100_000)], ids=["cut", "NUL", "many NUL"])
@pytest.mark.parametrize("suffix", CUT)
def test_of_a_text_log_that_is_cut_at_any_byte_all_before_the_cut_is_read(tmp_path, utc, suffix, tail):
    path, content = tmp_path / f"can{suffix}", CUT[suffix].encode()
    path.write_bytes(content)
    everything = poses_in(path)[0]
    lines = {line.strip() for line in content.splitlines()}
    rotations = [line.end() for line in re.finditer(rb".* 0?111[ #].*\n", content)]
    assert len(rotations) == len(everything) == 20
    for n_bytes in range(1, len(content), 7):
        path.write_bytes(content[:n_bytes] + tail)
        n_whole = sum(end <= n_bytes for end in rotations)
        try:
            poses, reader = poses_in(path)
        except BusLogError:
            # Nothing but a part of its first line is there.
            assert n_whole == 0
            assert b"\n" not in content[:n_bytes]
            continue
        assert poses[:n_whole] == everything[:n_whole]
        # The last byte that is cut off may be the line's end alone.
        assert len(poses) - n_whole in (0, 1)
        assert poses == everything[: len(poses)]
        last = content[:n_bytes].rpartition(b"\n")[2].strip()
        # A last byte 00 of which one digit is there is read as what it is.
        if n_whole and (tail or (last and not lines & {last, last + b"0"})):
            assert re.match(r"is cut off in line \d+: what stands before it is read", reader.damage)


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    suffix=st.sampled_from([".log", ".asc", ".trc"]), place=st.integers(0, 2**16), byte=st.integers(0, 255)
)
def test_a_changed_byte_never_makes_another_pose(tmp_path, suffix, place, byte):
    content = bytearray(CUT[suffix].encode())
    content[place % len(content)] = byte
    path = tmp_path / f"can{suffix}"
    path.write_bytes(content)
    try:
        poses, _ = poses_in(path)
    except BusLogError:
        return
    positions = {(round(x_mm, 6), y_mm) for _, x_mm, y_mm in poses}
    assert positions <= {(round(0.025 * round(4 * n), 6), 0.0) for n in range(20)}


def test_a_line_that_cannot_be_read_is_left_out_and_named(tmp_path):
    lines = log_text(pose_frames(6)).splitlines(keepends=True)
    # A computer lost power in the middle of a line, and wrote on after its start.
    lines[4:6] = [lines[4][:20] + lines[5]]
    path = tmp_path / "can.log"
    path.write_text("".join(lines))
    poses, reader = poses_in(path)
    assert [x_mm for _, x_mm, _ in poses] == pytest.approx([0.0, 0.1, 0.3, 0.4, 0.5])
    assert reader.damage == "line 5 cannot be read: it is left out"
    path.write_text("".join([*lines, "(1.5) can0\n"]))
    assert poses_in(path)[1].damage == "2 lines cannot be read, the first is line 5: they are left out"


@pytest.mark.parametrize("tail", [b"", bytes(500), b"\x17" * 500], ids=["cut", "NUL", "other bytes"])
def test_a_blf_that_is_cut_or_goes_on_otherwise_says_where(tmp_path, tail):
    path = tmp_path / "bus.blf"
    with BusLogWriter(path) as log:
        for frame in pose_frames(200):
            log.write(frame)
    everything, content = [r.timestamp_s for r in BusLogReader(path)], path.read_bytes()
    path.write_bytes(content[: 2 * len(content) // 3] + tail)
    reader = BusLogReader(path)
    times_s = [r.timestamp_s for r in reader]
    assert len(times_s) > 100
    assert times_s == everything[: len(times_s)]
    assert re.match(r"is cut off or damaged at byte \d+: what stands before it is read", reader.damage)
