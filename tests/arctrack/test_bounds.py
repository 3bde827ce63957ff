"""Nothing blocks, and nothing takes more memory than it may: what is refused, and in what words."""

from __future__ import annotations

import os
import select
import shutil
import socket
import struct
import subprocess
import sys
import zlib
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import av
import numpy as np
import pytest
from made import noise_frames, small_setup, write
from spoiled import Refusal, Spoil, instead, png, toml, toml_end

import arctrack
from arctrack.errors import ArctrackError
from arctrack.limits import LIMITS, Limits, size_problem
from arctrack.recording import VideoFormat, read_recording
from arctrack.recording.files import UnfitFileError, open_file, read_bytes, read_text

ROOT = Path(__file__).resolve().parents[2]

SPARE_BYTES = 200 << 20
"""Address space that a reader may take beside its libraries: less than what any refused file stands for."""

READER = f"""
import resource, sys
from arctrack.errors import ArctrackError
from arctrack.recording import BadFrame, read_recording, read_truth

def problem(path):
    try:
        bad = [frame.message for frame in read_recording(path).frames() if isinstance(frame, BadFrame)]
        read_truth(path)
        return bad[0] if bad else "nothing is wrong"
    except ArctrackError as error:
        return str(error)

problem(sys.argv[1])
taken = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (taken + {SPARE_BYTES}, taken + {SPARE_BYTES}))
for line in sys.stdin:
    print(problem(line.rstrip()), flush=True)
"""

WAIT_S = 60.0


class Reader:
    """A process that reads recordings with little memory to spare, and must answer in time."""

    def __init__(self, recording: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", READER, str(recording)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )

    def problem(self, path: Path) -> str:
        """Return the line on a recording."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{path}\n")
        self._process.stdin.flush()
        ready, _, _ = select.select([self._process.stdout], [], [], WAIT_S)
        assert ready, "the reader does not answer"
        return self._process.stdout.readline().rstrip()

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


@pytest.fixture(scope="module")
def reader(recording: Path) -> Iterator[Reader]:
    reader = Reader(recording)
    yield reader
    reader.close()


def grown(name: str, size: int) -> Spoil:
    """Return what makes a file so large, without a byte on the disk."""
    return lambda path: os.truncate(path / name, size)


def frame(content: bytes) -> Spoil:
    return lambda path: (path / "frames" / "000001.png").write_bytes(content) and None


def bind(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as unix, pytest.MonkeyPatch.context() as patch:
        # A socket's path is short.
        patch.chdir(path.parent)
        unix.bind(path.name)


def log(name: str, content: bytes) -> Spoil:
    return instead("poses.csv", lambda path: path.with_name(name).write_bytes(content) and None)


def blf(*objects: bytes) -> bytes:
    return b"LOGG" + struct.pack("<L", 144) + bytes(136) + b"".join(objects)


def lobj(kind: int, content: bytes, size: int | None = None, version: int = 1) -> bytes:
    size = 16 + len(content) if size is None else size
    return struct.pack("<4sHHLL", b"LOBJ", 16, version, size, kind) + content


def container(method: int, content: bytes) -> bytes:
    return lobj(10, struct.pack("<H6xL4x", method, len(content)) + content)


def video_script(path: Path) -> None:
    """Put a script that names another video in the place of the frames."""
    secret = path.with_name("secret.mkv")
    write(path.parent / "other", small_setup(), noise_frames(small_setup(), 4), video=VideoFormat(10.0))
    (path.parent / "other" / "frames.mkv").rename(secret)
    path.with_name("frames.mkv").write_text("ffconcat version 1.0\nfile secret.mkv\n")


def large_video(path: Path) -> None:
    with av.open(str(path.with_name("frames.mkv")), mode="w") as video:
        stream = video.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 8192, 4096, "gray"
        stream.options = {"level": "3", "g": "1"}
        video.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((4096, 8192), np.uint8), format="gray")))
        video.mux(stream.encode())


REFUSED: dict[str, tuple[Spoil, str, str]] = {
    "a PNG of 2 GB": (
        frame(png(46_000, 46_000)),
        "000001.png",
        "is 46000 x 46000, [camera] width and height say",
    ),
    "a file of 1 TB for a PNG": (
        grown("frames/000001.png", 1 << 40),
        "000001.png",
        "has 1099.5 GB: 1.1 MB is",
    ),
    "a camera of 16384 x 16384": (
        lambda path: (toml("width = 48", "width = 16384")(path), toml("height = 36", "height = 16384")(path))[
            0
        ],
        "recording.toml",
        "[camera] width, height: 16384 x 16384 px are 268.4 million: 16.8 million px are the most",
    ),
    "a blur of kilometres": (
        toml("psf_sigma_px = ", "psf_sigma_px = 1e9 #"),
        "recording.toml",
        "[camera] psf_sigma_px = 1000000000.0: input should be less than or equal to 100",
    ),
    "a width of 20 000 digits": (
        toml("width = 48", f"width = 0x{20_000 * 'F'}"),
        "recording.toml",
        "[camera] width = an integer of 80000 bits: input should be less than or equal to 16384",
    ),
    "a focal length of 20 000 digits": (
        toml("fx = ", f"fx = 0x{20_000 * 'F'} #"),
        "recording.toml",
        "[camera] fx = an integer of 80000 bits: input should be a valid number",
    ),
    "an effect of 20 000 digits": (
        toml_end(f"[effects.gamma]\ngamma = 0x{20_000 * 'F'}"),
        "recording.toml",
        "[effects.gamma] gamma = an integer of 80000 bits: must be a finite number",
    ),
    "keys 3 000 deep": (
        toml_end("[x]\n" + ".".join(3000 * ["a"]) + " = 1"),
        "recording.toml",
        "a key of more than 32 parts is nested too deep",
    ),
    "keys 200 000 deep": (
        toml_end('"a".' * 200_000 + "a = 1"),
        "recording.toml",
        "a key of more than 32 parts is nested too deep",
    ),
    "tables 60 deep": (
        toml_end(f"[{'.'.join(30 * 'a')}]\n{'.'.join(30 * 'b')} = 1"),
        "recording.toml",
        "a is nested too deep: 32 tables or arrays are the most",
    ),
    "arrays 3 000 deep": (
        toml_end(f"x = {3000 * '['}{3000 * ']'}"),
        "recording.toml",
        "is nested too deep: 32 tables or arrays are the most",
    ),
    "a setup of 1 TB": (
        grown("recording.toml", 1 << 40),
        "recording.toml",
        "has 1099.5 GB: 1.0 MB is the most",
    ),
    "poses of 1 TB": (grown("poses.csv", 1 << 40), "poses.csv", "has 1099.5 GB: 268.4 MB is the most"),
    "a log of 1 TB": (
        lambda path: (log("can.blf", blf())(path), grown("can.blf", 1 << 40)(path))[0],
        "can.blf",
        "has 1099.5 GB: 1.1 GB is the most",
    ),
    "a container of 1 GB": (
        log("can.blf", blf(container(2, zlib.compress(bytes(1 << 28), 9)))),
        "can.blf",
        "a container unpacks to more than 16777216 bytes",
    ),
    "an object without end": (
        log("can.blf", blf(container(0, lobj(1, bytes(64), size=0, version=3)))),
        "can.blf",
        "an object in a container of 0 bytes: 16 to 1048576 are possible",
    ),
    "an object larger than any": (
        log("can.blf", blf(container(0, lobj(1, bytes(64), size=1 << 31)))),
        "can.blf",
        "an object in a container of 2147483648 bytes",
    ),
    "a container smaller than its header": (
        log("can.blf", blf(lobj(10, b"", size=3))),
        "can.blf",
        "of 3 bytes",
    ),
    "a line without end": (
        log("can.asc", b"0 " * (1 << 20)),
        "can.asc",
        "a line of more than 65536 characters",
    ),
    "a video larger than its frames": (
        instead(
            "frames", lambda path: (video_script(path), os.truncate(path.with_name("frames.mkv"), 1 << 36))[0]
        ),
        "frames.mkv",
        "has 68.7 GB: 1.1 MB is the most",
    ),
    "a video of other frames": (
        instead("frames", large_video),
        "frames.mkv",
        "is 8192 x 4096, [camera] width and height in recording.toml say 48 x 36",
    ),
    "a script that names a video": (
        instead("frames", video_script),
        "frames.mkv",
        "cannot be read as a video: Invalid data found",
    ),
    "a FIFO for frames": (instead("frames", os.mkfifo), "frames", "is a FIFO: a folder of PNGs is needed"),
    "a FIFO for a video": (
        instead("frames", lambda path: os.mkfifo(path.with_name("frames.mkv"))),
        "frames.mkv",
        "is a FIFO: a regular file is needed",
    ),
    "a FIFO for the truth": (
        lambda path: os.mkfifo(path / "truth.csv"),
        "truth.csv",
        "is a FIFO: a regular file is needed",
    ),
    "a FIFO for a log": (
        instead("poses.csv", lambda path: os.mkfifo(path.with_name("can.blf"))),
        "can.blf",
        "is a FIFO: a regular file is needed",
    ),
    "a terminal for the setup": (
        instead("recording.toml", lambda path: path.symlink_to("/dev/tty")),
        "recording.toml",
        "is a device: a regular file is needed",
    ),
    **{
        f"a {kind} for {name}": (instead(name, put), name, f"is a {kind}: a regular file is needed")
        for name in ("recording.toml", "frames.csv", "poses.csv", "frames/000001.png")
        for kind, put in (
            ("FIFO", os.mkfifo),
            ("socket", bind),
            ("device", lambda path: path.symlink_to("/dev/zero")),
        )
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_without_waiting_and_without_memory(
    name: str, recording: Path, tmp_path: Path, reader: Reader
) -> None:
    spoil, file, problem = REFUSED[name]
    path = Path(shutil.copytree(recording, tmp_path / "r"))
    spoil(path)
    text = reader.problem(path)
    assert text.startswith(str(path))
    assert file in text
    assert problem in text


@pytest.mark.slow
def test_the_reader_has_nothing_against_a_good_recording(recording: Path, reader: Reader) -> None:
    assert reader.problem(recording) == "nothing is wrong"


def test_more_rows_than_a_table_may_have(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("arctrack.recording.csv_file.LIMITS", replace(LIMITS, csv_rows=3))
    with pytest.raises(ArctrackError, match=r"frames\.csv, line 5: holds more than 3 rows"):
        read_recording(recording)


@pytest.mark.parametrize(
    ("width", "height", "problem"),
    [
        (4096, 4096, None),
        (16_384, 1024, None),
        (4097, 4096, "4097 x 4096 px are 16.8 million: 16.8 million px are the most; bin or crop the image"),
        (20_000, 4, "20000 x 4 px: a side has 16384 px at most"),
    ],
)
def test_the_size_of_a_camera(width: int, height: int, problem: str | None) -> None:
    assert size_problem(width, height) == problem


def test_a_nominal_camera_that_is_too_large(tmp_path: Path, refusal: Refusal) -> None:
    with pytest.raises(ArctrackError, match=r"^width, height: 20000 x 20000 px: a side has 16384"):
        arctrack.nominal_setup("lap", "mild_steel", width=20_000, height=20_000)
    error = refusal("simulate", tmp_path / "s", "--width", "20000", "--height", "20000")
    assert error == "width, height: 20000 x 20000 px: a side has 16384 px at most"


@pytest.mark.slow
def test_a_file_that_grows_while_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(bytes(10))
    assert read_bytes(path, 10) == bytes(10)
    with pytest.raises(UnfitFileError, match="has 10 bytes: 9 bytes is the most"):
        open_file(path, 9)
    with pytest.raises(UnfitFileError, match="a NUL byte is in its name"):
        open_file(Path("a\0b"), 9)


@pytest.mark.slow
def test_lines_end_as_they_may_and_a_mark_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"\xef\xbb\xbfa\r\nb\rc\n")
    assert read_text(path, 100) == "a\nb\nc\n"


@pytest.mark.slow
def test_each_limit_says_what_it_bounds_and_where_it_comes_from() -> None:
    docs = (ROOT / "docs" / "reference" / "recording.md").read_text()
    for limit in fields(Limits):
        assert limit.metadata["role"]
        assert limit.metadata["source"]
        value = getattr(LIMITS, limit.name)
        number = f"{value:,}".replace(",", " ") if isinstance(value, int) else f"{value:g}"
        bound = f"{number} {limit.metadata['unit']}".rstrip()
        assert f"- {bound}: {limit.metadata['role']}\n" in docs
