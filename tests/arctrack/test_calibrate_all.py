"""`arctrack calibrate all`: raw files to a setup, a report and a certificate."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
from documented import run_once
from typer.testing import CliRunner

from arctrack import cli
from arctrack.recording import read_setup_file
from noise_model.compiled.arrays import Float64

pytestmark = pytest.mark.slow

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})
MAKE = "python examples/make_raw_files.py /tmp/afternoon"
CALIBRATE = (
    "arctrack calibrate all /tmp/afternoon --setup /tmp/afternoon/recording.toml --out /tmp/calibrated.toml"
)
MAX_MM = 0.05


def read(results: Path, what: str) -> Float64:
    """Return y and z (n, 2) of a replay's valid frames, NaN for others."""
    with (results / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    return np.array([[float(row[f"{what}_{axis}_mm"] or "nan") for axis in "yz"] for row in rows])


def test_raw_images_lead_to_the_seam_of_the_true_setup(scratch: Path, shared: Path) -> None:
    for command in (MAKE, CALIBRATE):
        run_once(command, scratch, shared)
    replays = [("", "/tmp/results"), (" --setup /tmp/calibrated.toml", "/tmp/replayed")]
    for option, out in replays:
        run_once(f"arctrack replay examples/v_groove{option} --out {out}", scratch, shared)
    true, found = (read(scratch / out[1:], "seam") for _, out in replays)
    assert np.isfinite(true).all(axis=1).sum() == 17
    off_mm = np.sqrt(np.nanmean((found - true) ** 2, axis=0))
    assert np.isfinite(found).all(axis=1).sum() == 17
    assert off_mm.max() < MAX_MM
    calibrated = read_setup_file(scratch / "tmp" / "calibrated.toml")
    sigma_mm = np.nanmin(read(scratch / "tmp" / "replayed", "sigma"), axis=0)
    # A level tool: the tool's axes are the joint's. The measurement's own share is small.
    assert sigma_mm == pytest.approx(calibrated.calibrations["certificate"].sigma, rel=0.1)
    assert (sigma_mm < np.nanmin(read(scratch / "tmp" / "results", "sigma"), axis=0)).all()
    page = (scratch / "tmp" / "calibrate_all.html").read_text()
    assert page.count("<details") == 5
    assert "http://www.w3.org" not in page.replace("data:", "")


def test_what_is_refused_keeps_its_values_and_the_rest_is_done(
    scratch: Path, shared: Path, tmp_path: Path
) -> None:
    run_once(MAKE, scratch, shared)
    folder = tmp_path / "short"
    folder.mkdir()
    for name in ("camera", "laser"):
        (folder / name).mkdir()
        for path in sorted((scratch / "tmp" / "afternoon" / name).glob("*_0[0-2].png")):
            shutil.copy(path, folder / name)
    shutil.copytree(scratch / "tmp" / "afternoon" / "sensor", folder / "sensor")
    (folder / "calibration.toml").write_text('board = "chessboard:9x6:4mm"\n')
    setup, out = scratch / "tmp" / "afternoon" / "recording.toml", tmp_path / "calibrated.toml"
    result = RUNNER.invoke(
        cli.app, ["calibrate", "all", str(folder), "--setup", str(setup), "--out", str(out)]
    )
    assert "3 images show the board" in str(result.exception)
    assert "laser: needs the camera, which was refused" in str(result.exception)
    assert "no certificate" in result.output
    before, after = (read_setup_file(path) for path in (setup, out))
    assert after.setup.camera.fx == before.setup.camera.fx
    assert after.setup.sensor.gain_e_per_dn == pytest.approx(80.0, rel=0.03)
    assert set(after.calibrations) == {"sensor"}
    assert "camera is refused" in (tmp_path / "calibrate_all.html").read_text()


def test_help_has_an_example() -> None:
    result = RUNNER.invoke(cli.app, ["calibrate", "all", "--help"])
    assert "Example: arctrack calibrate all /tmp/afternoon" in result.output
