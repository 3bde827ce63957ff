"""Ways to spoil a recording, and the one line that a command refuses it with."""

from __future__ import annotations

import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
from made import replace_in, replace_line

from arctrack import cli

Spoil = Callable[[Path], None]


def toml(old: str, new: str) -> Spoil:
    return lambda path: replace_in(path / "recording.toml", old, new)


def toml_end(text: str) -> Spoil:
    def append(path: Path) -> None:
        file = path / "recording.toml"
        file.write_text(f"{file.read_text()}\n{text}\n")

    return append


def line(file: str, number: int, text: str) -> Spoil:
    return lambda path: replace_line(path / file, number, text)


def content(file: str, changed: Callable[[bytes], bytes]) -> Spoil:
    """Return what changes a file's bytes."""
    return lambda path: (path / file).write_bytes(changed((path / file).read_bytes())) and None


def gone(name: str) -> Spoil:
    def remove(path: Path) -> None:
        target = path / name
        shutil.rmtree(target) if target.is_dir() else target.unlink()

    return remove


def instead(name: str, put: Spoil) -> Spoil:
    """Return what takes a file or folder away and puts something in its place."""

    def replace(path: Path) -> None:
        gone(name)(path)
        put(path / name)

    return replace


def png(width: int, height: int, bits: int = 8, colour: int = 0) -> bytes:
    """Return a PNG of zeros, whole by its checksums: pixels past the first megabytes are left out."""
    rows = zlib.compress(bytes(min(height * (width * bits // 8 + 1), 1 << 22)), 9)
    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", rows), (b"IEND", b""))
    packed = (
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


class Refusal:
    """Runs commands that must be refused: one line on stderr, exit code 2, nothing that a terminal obeys."""

    def __init__(self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        self._capsys, self._monkeypatch = capsys, monkeypatch

    def __call__(self, *arguments: object) -> str:
        """Return the line that a command ends with."""
        self._monkeypatch.setattr("sys.argv", ["arctrack", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_info:
            cli.main()
        assert exit_info.value.code == 2
        captured = self._capsys.readouterr()
        assert "\x1b" not in captured.out + captured.err
        (error,) = [text for text in captured.err.splitlines() if text.startswith("arctrack: error: ")]
        return error.removeprefix("arctrack: error: ")

    def assert_names_the_place(self, command: str, path: Path, case: tuple[Spoil, str, str]) -> None:
        """Spoil a recording: its line begins with its path, and says the file and the problem of the case."""
        spoil, file, problem = case
        spoil(path)
        error = self(command, path, *(["--no-pictures"] if command == "replay" else []))
        assert error.startswith(str(path))
        assert file in error
        assert problem in error
