"""`arctrack bead`: a drawn weld's recording gives a result with limits, and a page."""

import json
from pathlib import Path

import numpy as np
import pytest
from profiler_setup import profiler_setup
from typer.testing import CliRunner, Result

from arctrack.bead.seam_result import BeadLimits, Evaluation
from arctrack.cli import app
from arctrack.cli.json_output import json_text
from arctrack.errors import ArctrackError
from tracker.bead import BeadMeasure

RUNNER = CliRunner(env={"COLUMNS": "200", "TERM": "dumb", "NO_COLOR": "1"})
SETUP = profiler_setup(480, 0.05, ahead_mm=-40.0)
WIDTH_MM, HEIGHT_MM, PLATE_FRAME = 6.0, 1.2, 2


def run(*words: object) -> Result:
    return RUNNER.invoke(app, [*map(str, words)])


@pytest.fixture(scope="module")
def welded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of four profiles of a weld; the third is of a plate."""
    folder = tmp_path_factory.mktemp("bead")
    (folder / "recording.toml").write_text(SETUP)
    poses = "".join(f"{0.1 * n:.1f},{n},0,0,0,0,0,1\n" for n in range(-1, 6))
    (folder / "poses.csv").write_text("timestamp_s,x_mm,y_mm,z_mm,qx,qy,qz,qw\n" + poses)
    y_mm, rng = 0.05 * (np.arange(480) - 239.5), np.random.default_rng(0)
    face_mm = HEIGHT_MM * np.maximum(1.0 - (2.0 * y_mm / WIDTH_MM) ** 2, 0.0)
    rows = [(n != PLATE_FRAME) * face_mm + 0.01 * rng.standard_normal(480) for n in range(4)]
    lines = [",".join(f"{2000 + 100 * z_mm:.0f}" for z_mm in row) for row in rows]
    (folder / "rows.csv").write_text("\n".join(lines) + "\n")
    stated = {
        "layout": "rows",
        "separator": "comma",
        "decimal": "point",
        "nothing": "0",
        "up_mm": "0.01",
        "across_mm": "0.05",
        "zero": "2000",
    }
    options = [word for name, value in stated.items() for word in ("--profile", f"{name}={value}")]
    files = ("--setup", folder / "recording.toml", "--poses", folder / "poses.csv", "--rate-hz", "10")
    done = run("import", folder / "rows.csv", *files, "--out", folder / "welded", *options)
    assert done.exit_code == 0, done.output
    return folder / "welded"


@pytest.mark.slow
def test_a_weld_is_measured_against_its_limits(welded: Path, tmp_path: Path) -> None:
    done = run("bead", welded, "--limit", "width_mm=5:7", "--limit", "excess_mm=:1", "--out", tmp_path)
    # A profile shows none, and the bead is higher than allowed.
    assert done.exit_code == 1
    assert "3 of 4 profiles show the bead; beyond a limit" in done.output
    result = json.loads((tmp_path / "seam.json").read_text(), parse_constant=pytest.fail)
    about, content = result["ResultMetaData"], result["ResultContent"]
    assert (about["ResultEvaluation"], about["IsPartial"]) == (Evaluation.NOT_OK, True)
    assert about["ProcessingTimes"]["EndTime"] == pytest.approx(0.3)
    values = {value["Name"]: value for value in content["OverallResultValues"]}
    width, excess = values["width_mm"], values["excess_mm"]
    assert abs(width["MeasuredValue"] - WIDTH_MM) < 3.0 * width["Sigma"]
    assert abs(excess["MeasuredValue"] - HEIGHT_MM) < 3.0 * excess["Sigma"]
    assert (width["LowLimit"], width["HighLimit"], excess["HighLimit"]) == (5.0, 7.0, 1.0)
    assert "LowLimit" not in excess
    assert (width["EngineeringUnits"], excess["ResultEvaluation"]) == ("mm", Evaluation.NOT_OK)
    assert [one["problem"] for one in content["Slices"]] == [None, None, "no_bead", None]
    page = (tmp_path / "bead.html").read_text()
    assert "frame 2: no_bead" in page
    assert "Limits: width_mm at least 5 and at most 7, excess_mm at most 1." in page


@pytest.mark.parametrize(
    ("limit", "problem"),
    [
        ("depth_mm=1:2", "the measures are toe_right_mm"),
        ("width_mm=4", "give NAME=LOW:HIGH"),
        ("width_mm=wide:", "give NAME=LOW:HIGH"),
        ("width_mm=8:4", "give NAME=LOW:HIGH"),
        ("width_mm=nan:4", "give NAME=LOW:HIGH"),
    ],
)
def test_a_wrong_limit_is_named(welded: Path, limit: str, problem: str) -> None:
    done = run("bead", welded, "--limit", limit)
    assert isinstance(done.exception, ArctrackError)
    assert problem in str(done.exception)


def test_images_have_no_bead() -> None:
    done = run("bead", Path(__file__).parents[2] / "examples" / "v_groove")
    assert isinstance(done.exception, ArctrackError)
    assert "a bead is measured in profiles" in str(done.exception)


def test_what_a_sigma_leaves_open_is_not_decided() -> None:
    limits = BeadLimits(1.0, 2.0)
    cases = {
        1.5: Evaluation.OK,
        1.9: Evaluation.NOT_DECIDABLE,
        2.2: Evaluation.NOT_DECIDABLE,
        2.4: Evaluation.NOT_OK,
    }
    assert {value: limits.evaluate(BeadMeasure(value, 0.1)) for value in cases} == cases
    assert limits.evaluate(BeadMeasure(0.6, 0.1)) == Evaluation.NOT_OK
    assert limits.evaluate(BeadMeasure(1.5, float("nan"))) == Evaluation.NOT_DECIDABLE
    assert json_text({"Sigma": float("nan")}) == '{\n "Sigma": null\n}'
