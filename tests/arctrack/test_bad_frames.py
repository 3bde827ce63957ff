"""Frames that cannot be used: one line that names the file and what is wrong, exit code 2."""

import shutil
from pathlib import Path

import pytest
from made import noise_frames, replace_in, small_setup, write
from spoiled import Refusal, Spoil, gone, instead, png

from arctrack.errors import ArctrackError
from arctrack.recording import BadFrame, VideoFormat, read_recording


def cut_png(path: Path) -> None:
    png = path / "frames" / "000002.png"
    png.write_bytes(png.read_bytes()[:-30])


def frame(content: bytes) -> Spoil:
    return lambda path: (path / "frames" / "000001.png").write_bytes(content) and None


BAD: dict[str, tuple[Spoil, str, str]] = {
    "no frames": (gone("frames"), "frames", "no frames"),
    "one frame gone": (gone("frames/000002.png"), "000002.png", "no such file"),
    "png truncated": (cut_png, "000002.png", "truncated"),
    "frame of another size": (
        frame(png(12, 10)),
        "000001.png",
        "12 x 10, [camera] width and height say 48 x 36",
    ),
    "colours": (
        frame(png(48, 36, colour=2)),
        "000001.png",
        "is a colour picture, 3 channels: a raw grey frame",
    ),
    "a palette": (frame(png(48, 36, colour=3)), "000001.png", "is a colour picture, 3 channels"),
    "grey with transparency": (frame(png(48, 36, colour=4)), "000001.png", "has a third axis, 2 channels"),
    "rows for columns": (
        frame(png(36, 48)),
        "000001.png",
        "is 36 x 48, [camera] width and height say 48 x 36; it is turned: swap rows and columns",
    ),
    "16 bits": (
        frame(png(48, 36, bits=16)),
        "000001.png",
        "holds uint16, 16 bits a pixel: [sensor] bits = 8 needs raw codes in uint8",
    ),
    "1 bit": (frame(png(48, 36, bits=1)), "000001.png", "has 1 bits a pixel: grey levels of 8 or 16"),
    "no header": (
        frame(png(48, 36)[:8] + png(48, 36)[33:]),
        "000001.png",
        "is no PNG: its header is wrong",
    ),
    "no bytes": (frame(b""), "000001.png", "is empty"),
    "a folder": (
        instead("frames/000001.png", lambda path: path.mkdir()),
        "000001.png",
        "is a folder: a regular file is needed",
    ),
    "a link that leads to itself": (
        instead("frames/000001.png", lambda path: path.symlink_to(path)),
        "000001.png",
        "cannot be read: Too many levels of symbolic links",
    ),
    "a file for the folder": (
        instead("frames", lambda path: path.write_bytes(b"") and None),
        "frames",
        "is a file: a folder of PNGs is needed",
    ),
}


def refused(path: Path) -> str:
    """Return the line on a recording that cannot be opened, or on its one frame that cannot be used."""
    try:
        bad = [frame for frame in read_recording(path).frames() if isinstance(frame, BadFrame)]
    except ArctrackError as error:
        return str(error)
    (frame,) = bad
    return frame.message


@pytest.mark.parametrize("name", BAD)
def test_it_is_one_line_with_the_file(name: str, recording: Path, tmp_path: Path) -> None:
    spoil, file, problem = BAD[name]
    path = Path(shutil.copytree(recording, tmp_path / "r"))
    spoil(path)
    error = refused(path)
    assert error.startswith(str(path))
    assert file in error
    assert problem in error


@pytest.mark.parametrize("command", ["inspect", "replay"])
def test_a_command_ends_with_that_line(
    command: str, recording: Path, tmp_path: Path, refusal: Refusal
) -> None:
    path = Path(shutil.copytree(recording, tmp_path / "r"))
    frame(png(48, 36, colour=2))(path)
    error = refusal(command, path, *(["--no-pictures"] if command == "replay" else []))
    assert error.startswith(f"{refused(path)}; 1 of 4 frames could not be used")


def test_a_video_of_another_size(tmp_path: Path, refusal: Refusal) -> None:
    setup = small_setup()
    path = write(tmp_path / "r", setup, noise_frames(setup, 3), video=VideoFormat(10.0))
    replace_in(path / "recording.toml", "width = 48", "width = 64")
    error = refusal("replay", path)
    assert "frames.mkv: is 48 x 36, [camera] width and height in recording.toml say 64 x 36" in error
