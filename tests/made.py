"""Small recordings for the tests, and ways to spoil them."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import tomlkit

from arctrack.control.cell_file.new import write_new_cell
from arctrack.nominal import nominal_setup
from arctrack.recording import RecordingWriter, VideoFormat
from noise_model.setup import Setup
from tracker.state import Frame

WIDTH, HEIGHT = 48, 36

UNREADABLE = 5
"""The frame of `flawed_recording` that cannot be read."""


def small_setup(bits: int = 8) -> Setup:
    setup = nominal_setup("v_groove", "mild_steel", width=WIDTH, height=HEIGHT)
    return replace(setup, sensor=replace(setup.sensor, bits=bits))


def noise_frames(setup: Setup, n: int, seed: int = 0) -> list[Frame]:
    """Return frames of pure noise over all codes, one each 0.1 s."""
    rng = np.random.default_rng(seed)
    shape = (setup.camera.height, setup.camera.width)
    return [
        Frame(
            index=i,
            timestamp_s=0.1 * i,
            image_dn=rng.integers(0, setup.sensor.max_dn + 1, shape).astype(setup.sensor.dtype),
            exposure_s=0.005 if i % 2 else 0.0025,
            current_a=float("nan") if i == 3 else 100.0,
            laser_on=i != 0,
            arc_on=i != 1,
        )
        for i in range(n)
    ]


def level_pose(timestamp_s: float) -> np.ndarray:
    """Return T_base_tool of a level tool that travels at 8 mm/s, 1 mm high."""
    T_base_tool = np.eye(4)
    T_base_tool[:3, 3] = 8.0 * timestamp_s, 0.0, 1.0
    return T_base_tool


def write(
    path: Path,
    setup: Setup,
    frames: Sequence[Frame],
    *,
    video: VideoFormat | None = None,
    poses_until_s: float | None = None,
) -> Path:
    """Write a recording with poses at 100 Hz."""
    end_s = frames[-1].timestamp_s + 0.05 if poses_until_s is None else poses_until_s
    with RecordingWriter(path, setup, video=video) as writer:
        for frame in frames:
            writer.write_frame(frame)
        for timestamp_s in np.arange(-0.2, end_s, 0.01):
            writer.write_pose(float(timestamp_s), level_pose(float(timestamp_s)))
    return path


def replace_in(path: Path, old: str, new: str) -> None:
    """Replace text that must be there once."""
    text = path.read_text()
    assert text.count(old) == 1, (path, old, text.count(old))
    path.write_text(text.replace(old, new))


def replace_line(path: Path, line: int, new: str) -> None:
    """Replace a line, counted from 1."""
    lines = path.read_text().splitlines()
    lines[line - 1] = new
    path.write_text("\n".join(lines) + "\n")


def results_of(folder: Path) -> list[dict[str, str]]:
    """Return the rows of results.csv."""
    with (folder / "results.csv").open() as file:
        return list(csv.DictReader(file))


def assert_cell(value: float | None, cell: str) -> None:
    """Hold a number, None for unknown, against its cell of results.csv."""
    if cell == "":
        assert value is None
    else:
        assert value is not None
        assert abs(value - float(cell)) <= 1e-4


def playing_cell(folder: Path, recording: Path) -> Path:
    """Return the cell file of a cell whose camera is a recording, on a bus of its own."""
    cell_path, setup_path = write_new_cell(folder, "v_groove", "mild_steel")
    setup_path.write_bytes((recording / "recording.toml").read_bytes())
    document = tomlkit.parse(cell_path.read_text())
    document["bus"]["channel"] = str(folder)
    document["camera"].update({"kind": "recording", "name": str(recording)})
    document["monitor"] = {"enabled": False}
    cell_path.write_text(tomlkit.dumps(document))
    return cell_path


PROGRESS = re.compile(r", \d+ s$|, about [^,]* left$|: compiled \d+ functions")


def without_progress(stderr: str) -> list[str]:
    """Return a command's lines on stderr but those of its progress, of which a slow machine has more."""
    return [line for line in stderr.splitlines() if not re.search(PROGRESS, line)]
