"""`arctrack shift`: from two files of found points to the frame that a program is moved by."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.errors import ArctrackError
from noise_model.compiled.arrays import Float64

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})
PLACES = {
    "a": ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
    "b": ([300.0, 0.0, 40.0], [0.0, 1.0, 0.0]),
    "c": ([300.0, 200.0, 0.0], [1.0, 0.0, 0.0]),
    "d": ([0.0, 200.0, 0.0], [0.0, 1.0, 0.0]),
}


def points_file(path: Path, T: Float64, kinds: str = "seam", **others: object) -> Path:
    points = []
    for name, (place, along) in PLACES.items():
        x = np.array(along)
        axes = np.array([x, np.cross([0.0, 0.0, 1.0], x), [0.0, 0.0, 1.0]])
        variance = 1e-4
        points.append(
            {
                "name": name,
                "kind": kinds,
                "refusal": "",
                "point_base_mm": (T[:3, :3] @ place + T[:3, 3]).tolist(),
                "axes_base": (axes @ T[:3, :3].T).tolist(),
                "covariance_mm2": [[None, 0, 0], [0, variance, 0], [0, 0, variance]],
                "direction_covariance": [[1e-6, 0], [0, 1e-6]],
                "calibration_base_mm": [],
                "calibration": "",
                "faces_base": [[None] * 3] * 2,
                "face_sigmas_rad": [None, None],
                **others,
            }
        )
    path.write_text(json.dumps({"format": "arctrack-found/1", "points": points}))
    return path


def test_a_shift_is_printed_and_written(tmp_path: Path) -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", 2.0, degrees=True).as_matrix()
    T[:3, 3] = 5.0, -3.0, 1.0
    master, part = points_file(tmp_path / "m.json", np.eye(4)), points_file(tmp_path / "p.json", T)
    program = tmp_path / "program.csv"
    program.write_text("x_mm,y_mm,z_mm\n0,0,0\n400,300,50\n")
    out = tmp_path / "shift.json"
    words = ["shift", str(master), str(part), "--program", str(program), "--out", str(out)]
    result = RUNNER.invoke(app, words)
    assert result.exit_code == 0, result.output
    assert "x 5.000, y -3.000, z 1.000 mm in base" in result.output
    assert "A 2.0000, B 0.0000, C 0.0000 deg" in result.output.replace("-0.0000", "0.0000")
    content = json.loads(out.read_text())
    assert content["T_shift"] == pytest.approx(T, abs=1e-6)
    assert content["wrong"] is None
    assert RUNNER.invoke(app, [*words, "--within-mm", "0.01"]).exit_code == 3


def test_a_shift_that_is_refused_says_why(tmp_path: Path) -> None:
    master = points_file(tmp_path / "m.json", np.eye(4))
    held = json.loads(master.read_text())
    held["points"] = [point for point in held["points"] if point["name"] in "ac"]
    for name in ("m.json", "p.json"):
        (tmp_path / name).write_text(json.dumps(held))
    result = RUNNER.invoke(app, ["shift", str(master), str(tmp_path / "p.json")])
    assert result.exit_code == 3
    assert result.output.startswith("refused: the points do not determine a shift along")


def test_what_does_not_fit_together_is_named(tmp_path: Path) -> None:
    master = points_file(tmp_path / "m.json", np.eye(4))
    for part, options, complaint in (
        (points_file(tmp_path / "e.json", np.eye(4), "end"), [], "a is of kind end, in .* seam"),
        (points_file(tmp_path / "r.json", np.eye(4), refusal="gap"), [], "none was found that"),
        (master, ["--free", "x,w"], "w is none of rx,ry,rz,x,y,z"),
    ):
        result = RUNNER.invoke(app, ["shift", str(master), str(part), *options])
        assert isinstance(result.exception, ArctrackError)
        assert re.search(complaint, str(result.exception))
