"""`arctrack find`: the points of recordings in a file, the part's limits, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.errors import ArctrackError
from arctrack.recording import read_recording, read_truth
from arctrack.recording.found_file import read_found
from noise_model.transforms import transform

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})


@pytest.mark.slow
def test_a_point_lies_on_the_true_seam_and_is_read_as_it_was_written(simulated: Path, tmp_path: Path) -> None:
    out = tmp_path / "part.json"
    result = RUNNER.invoke(app, ["find", str(simulated), "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "v: seam at (" in result.output
    (point,) = read_found(out)
    found = point.to_found()
    recording, truth = read_recording(simulated), read_truth(simulated)
    assert truth is not None
    poses = recording.poses_at([row.timestamp_s for row in recording.rows])
    true_base = np.array(
        [
            transform(pose.T_base_tool, np.array(truth.seam_tool_mm[n]))
            for n, pose in enumerate(poses)
            if pose is not None
        ]
    )
    assert np.isinf(found.covariance_mm2[0, 0])
    off_mm = (true_base - found.point_base_mm) @ found.axes_base[1:].T
    assert np.all(np.abs(off_mm) < 3.0 * found.sigma_mm[1:])
    # Another point is added, the same one replaced.
    again = RUNNER.invoke(app, ["find", str(simulated), "--out", str(out)])
    assert "1 point; the one before is part.json.1" in again.output or "part.json: 1 point" in again.output
    other = Path(shutil.copytree(simulated, tmp_path / "w"))
    RUNNER.invoke(app, ["find", str(other), "--out", str(out)])
    assert [each.name for each in read_found(out)] == ["v", "w"]


@pytest.mark.slow
def test_a_part_beyond_the_jobs_limits_is_refused_by_name(simulated: Path, tmp_path: Path) -> None:
    cell = tmp_path / "cell.toml"
    cell.write_text(
        f'format = "arctrack-cell/1"\nsetup = "{simulated / "recording.toml"}"\n'
        '[bus]\ninterface = "virtual"\nchannel = "find"\n[camera]\nframe_rate_hz = 25.0\n'
        '[jobs.1]\nname = "v"\n[jobs.1.part]\n'
        "gap_mm = [1.5, 2.0]\n"
    )
    result = RUNNER.invoke(app, ["find", str(simulated), "--cell", str(cell)])
    assert (result.exit_code, "v: refused, gap" in result.output) == (3, True), result.output
    assert "gap 1.0" in result.output or "gap 0.9" in result.output


@pytest.mark.slow
def test_an_end_that_was_not_passed_is_refused(simulated: Path) -> None:
    result = RUNNER.invoke(app, ["find", str(simulated), "--kind", "end"])
    assert (result.exit_code, result.output.strip()) == (3, "v: refused, end_not_passed")


def test_a_file_of_points_is_read_strictly(tmp_path: Path) -> None:
    path = tmp_path / "part.json"
    for text, complaint in (
        ("{", "part.json"),
        (json.dumps({"format": "arctrack-found/1"}), "points: missing"),
        (json.dumps({"format": "another", "points": []}), "arctrack-found/1"),
    ):
        path.write_text(text)
        with pytest.raises(ArctrackError, match=complaint):
            read_found(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "complaint"),
    [(["--kind", "corner"], "two recordings"), (["--kind", "seem"], "must be seam, start, end or corner")],
)
def test_what_cannot_be_found_is_named(simulated: Path, options: list[str], complaint: str) -> None:
    result = RUNNER.invoke(app, ["find", str(simulated), *options])
    assert isinstance(result.exception, ArctrackError)
    assert complaint in str(result.exception)
