"""`arctrack calibrate sheet` on small recordings of a flat plate."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from calibrate_commands import command
from mistaken import edit_setup
from plate_scenes import HEIGHTS_AND_TILTS, STATED, displaced, stripes, write_recording

from arctrack.errors import ArctrackError
from arctrack.recording import read_setup_file
from noise_model.setup import Setup

calibrate = command("sheet")

TRUE = displaced(np.random.default_rng(4))


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a scan of a plate at three heights and tilts, four frames at each."""
    shown = stripes(TRUE, HEIGHTS_AND_TILTS, np.random.default_rng(4))[::2]
    return write_recording(tmp_path_factory.mktemp("plate") / "scan", shown)


def off_seam_mm(setup: Setup) -> float:
    """Return how far a setup's sheet is off the true one where the stripe is, along its normal."""
    middle = np.array([-TRUE.laser.plane[3] / TRUE.laser.plane[0], 0.0, 0.0, 1.0])
    return abs(float(setup.laser.plane @ middle))


@pytest.mark.slow
def test_a_scan_of_a_plate_corrects_the_sheet(plate: Path, tmp_path: Path) -> None:
    out = tmp_path / "new.toml"
    result = calibrate(plate, "--out", out)
    assert result.exit_code == 0, result.output
    setup, tables = read_setup_file(out).setup, tomllib.loads(out.read_text())["calibration"]
    assert off_seam_mm(STATED) > 1.0
    assert off_seam_mm(setup) < 4.0 * tables["laser"]["sigma"][3] < 2.0
    assert tables["laser"]["made_by"] == "arctrack calibrate sheet"
    assert tables["certificate"]["sigma"][1] < 1.5
    assert setup.calibration is not None
    assert setup.calibration.names[-4:] == ("n_x", "n_y", "n_z", "d_mm")
    assert "Camera and sheet together place a seam point to" in result.output
    assert (tmp_path / "calibrate_sheet.html").read_text().count("data:image") == 2


@pytest.mark.slow
def test_scans_of_one_plate_count_together(plate: Path, tmp_path: Path) -> None:
    shown = stripes(TRUE, HEIGHTS_AND_TILTS, np.random.default_rng(4))
    low, high = (
        write_recording(tmp_path / name, part) for name, part in (("low", shown[:8]), ("high", shown[8:]))
    )
    result = calibrate(low, high, "--out", tmp_path / "new.toml")
    assert result.exit_code == 0, result.output
    assert "22 frames of 22 poses" in result.output


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("one pose", "all frames are of one pose: raise, tilt or move the tool between them"),
        ("dark", "frames are left out, .* shows no straight stripe"),
        ("another camera", r"left out, .*\.png is 640 x 480, \[camera\] width and height say 808 x 480"),
        ("saturated", "frames are left out, .* its stripe is saturated: shorten the exposure"),
        ("no poses", "the robot's pose is known at no frame of the laser alone"),
        ("arc on", "has no frame of the laser alone: take them with the arc off"),
    ],
)
def test_what_does_not_serve_is_refused_in_a_line(plate: Path, tmp_path: Path, kind: str, why: str) -> None:
    shown = stripes(TRUE, HEIGHTS_AND_TILTS, np.random.default_rng(4))[::2]
    if kind == "one pose":
        shown = [shown[0]] * 5
    folder = write_recording(tmp_path / "scan", shown, {"dark": 0.0, "saturated": 1e30}.get(kind, 150.0))
    frames, poses = folder / "frames.csv", folder / "poses.csv"
    if kind == "no poses":
        head, first, *_ = poses.read_text().splitlines()
        late = first.replace("-0.05", "-9.05"), first.replace("-0.05", "-9.00")
        poses.write_text("\n".join([head, *late]) + "\n")
    if kind == "another camera":
        edit_setup(folder, lambda document: document["camera"].update(width=808))
    if kind == "arc on":
        frames.write_text(frames.read_text().replace(",1,0,0,0.005", ",1,1,100,0.005"))
    result = calibrate(folder)
    assert isinstance(result.exception, ArctrackError), result.output
    assert result.exception.args[0].count("\n") == 0
    with pytest.raises(ArctrackError, match=why):
        raise result.exception
    assert not (folder / "recording.toml.1").exists()


def test_help_has_an_example() -> None:
    assert "Example: arctrack calibrate sheet /tmp/plate" in calibrate("--help").output
