"""The commands that calibrate, as their tests run them, and the setup that their pictures belong to."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from typer.testing import CliRunner, Result

from arctrack import cli
from arctrack.recording import CalibrationValues, with_calibrated

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})
EXAMPLES = Path(__file__).parents[1] / "examples"
BOARD = ("--board", "chessboard:7x6:10mm")


def command(name: str) -> Callable[..., Result]:
    """Return what runs `arctrack calibrate` of a name with some words."""
    return lambda *words: RUNNER.invoke(cli.app, ["calibrate", name, *map(str, words)])


def copied_setup(folder: Path) -> Path:
    """Return the example's setup in a folder."""
    return Path(shutil.copy(EXAMPLES / "v_groove" / "recording.toml", folder / "recording.toml"))


def setup_with_camera(folder: Path, size: tuple[int, int], pinhole: Mapping[str, float]) -> Path:
    """Return a setup whose camera is that of the pictures, with the covariance of its calibration."""
    path = copied_setup(folder)
    values = {"width": size[0], "height": size[1], **pinhole}
    camera = CalibrationValues(
        "camera", values, tuple(pinhole), np.diag([0.01] * 4), "arctrack calibrate camera"
    )
    path.write_text(with_calibrated(path, camera) + "# mine\n")
    return path
