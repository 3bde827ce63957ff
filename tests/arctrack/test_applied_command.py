"""`arctrack diagnose --apply --on`: effects added to a setup and tried on frames that no fit has seen."""

import json
import shutil
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from browser import Page
from diagnosis_examples import GAMMA, example, gap_of
from made import replace_in, without_progress
from typer.testing import CliRunner, Result

from arctrack import cli
from arctrack.diagnose.diagnosis_files import ADDED_FILES, FILES
from arctrack.errors import ArctrackError
from arctrack.recording import read_recording
from arctrack.simulation.simulate import SimulationPlan, simulate_recording
from noise_model.setup import Setup
from sim_to_real.diagnosis import DiagnosisVerdict

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})


@pytest.fixture
def monday(simulated: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(simulated, tmp_path / "monday"))


@pytest.fixture(scope="module")
def tuesday(tmp_path_factory: pytest.TempPathFactory, seen_setup: Setup) -> Path:
    """Another run over the same seam: another weave, other noise, the hidden effect alone."""
    plan = SimulationPlan(frames=14, tilt_deg=2.0, weave_mm=2.5, seed=7)
    effects = {**GAMMA, "laser_speckle": {"contrast": 0.0}}
    return simulate_recording(
        tmp_path_factory.mktemp("on") / "tuesday", seen_setup, plan, hidden_effects=effects
    )


@pytest.fixture(autouse=True)
def verdict(monkeypatch: pytest.MonkeyPatch) -> dict[str, DiagnosisVerdict]:
    """The verdict of every diagnosis, which a test may change."""
    given = {"verdict": DiagnosisVerdict.EFFECTS}
    stub = types.ModuleType("sim_to_real.diagnose")
    stub.diagnose = lambda setup, *_, **__: example(given["verdict"], setup)
    monkeypatch.setitem(sys.modules, "sim_to_real.diagnose", stub)
    return given


def run(*arguments: object) -> Result:
    return RUNNER.invoke(cli.app, ["diagnose", *map(str, arguments)])


def refused(*arguments: object) -> str:
    with pytest.raises(ArctrackError) as raised:
        RUNNER.invoke(cli.app, ["diagnose", *map(str, arguments)], catch_exceptions=False)
    return str(raised.value)


def test_own_frames_answer_where_no_other_recording_is_given(monday: Path) -> None:
    result = run(monday, "--apply")
    assert result.exit_code == 0, result.output
    folder = monday / "diagnosis"
    assert {path.name for path in folder.iterdir()} == {*FILES, *ADDED_FILES}
    content = json.loads((folder / "applied.json").read_text(), parse_constant=pytest.fail)
    assert content["gap"] == json.loads((folder / "report.json").read_text())["gap"]
    assert content["fitted_on"] == content["predicted_on"] == "monday"
    assert content["frames"] == {"held_out": 4, "nuisances_fitted": 10}
    assert "gamma closes the gap on monday, from" in result.stdout
    assert "to its 10 other frames" in " ".join(result.stdout.split())
    # A later diagnosis takes its former answer away.
    run(monday)
    assert {path.name for path in folder.iterdir()} == set(FILES)


@pytest.mark.slow
def test_another_recording_answers_by_what_no_fit_has_seen(
    monday: Path, tuesday: Path, browser: Page
) -> None:
    before = (tuesday / "recording.toml").read_bytes()
    result = run(monday, "--apply", "--on", tuesday)
    assert result.exit_code == 0, result.output
    assert read_recording(monday).setup.effects["gamma"]["gamma"] == 0.74
    assert (tuesday / "recording.toml").read_bytes() == before
    folder = monday / "diagnosis"
    content = json.loads((folder / "applied.json").read_text(), parse_constant=pytest.fail)
    assert content["format"] == "arctrack-applied/1"
    assert (content["fitted_on"], content["predicted_on"]) == ("monday", "tuesday")
    gap = content["gap"]
    assert gap["closed"] > 0.8
    assert gap["ci95"][0] <= gap["closed"] <= gap["ci95"][1]
    with np.load(folder / "applied.npz") as arrays:
        assert gap_of(arrays["recorded"], arrays["before"], arrays["variance"]) == pytest.approx(
            gap["before"], rel=1e-3
        )
    assert " on tuesday, from " in result.stdout
    browser.open(folder / "applied.html")
    assert browser.text("h1").startswith("gamma closes")
    assert browser.value("document.images.length") == 6
    browser.assert_readable()


@pytest.mark.slow
def test_an_effect_that_is_not_there_is_said_to_close_nothing(
    monday: Path, simulated: Path, tmp_path: Path
) -> None:
    """The other recording has no gamma: with it the gap grows. Without --apply no setup is written."""
    quiet = Path(shutil.copytree(simulated, tmp_path / "quiet"))
    before = (monday / "recording.toml").read_bytes()
    result = run(monday, "--on", quiet)
    assert result.exit_code == 0, result.output
    assert "a gap on quiet" in result.stdout or "the gap larger on quiet" in result.stdout
    assert json.loads((monday / "diagnosis" / "applied.json").read_text())["gap"]["p_nearer"] < 0.5
    assert (monday / "recording.toml").read_bytes() == before


@pytest.mark.parametrize("open_verdict", [v for v in DiagnosisVerdict if v is not DiagnosisVerdict.EFFECTS])
def test_a_verdict_that_names_nothing_has_nothing_to_add(
    open_verdict: DiagnosisVerdict, verdict: dict[str, DiagnosisVerdict], monday: Path, tuesday: Path
) -> None:
    verdict["verdict"] = open_verdict
    before = (monday / "recording.toml").read_bytes()
    result = run(monday, "--apply", "--on", tuesday)
    assert result.exit_code == 2
    (error,) = (line for line in without_progress(result.stderr) if "error" in line)
    assert error == (
        f"arctrack: error: {monday}: --on {tuesday} was not predicted: the verdict {open_verdict.value!r} "
        "names no effect that could be added"
    )
    assert (monday / "recording.toml").read_bytes() == before
    assert not (monday / "diagnosis" / "applied.json").exists()


def test_a_recording_that_does_not_fit_is_refused_before_anything_is_computed(
    monday: Path, tuesday: Path, tmp_path: Path
) -> None:
    other = Path(shutil.copytree(tuesday, tmp_path / "other"))
    assert "diagnose one at a time" in refused(monday, other, "--on", tuesday)
    assert "is the recording that is diagnosed" in refused(monday, "--apply", "--on", monday)
    assert "no-such" in refused(monday, "--on", tmp_path / "no-such")
    text = (other / "recording.toml").read_text()
    (other / "recording.toml").write_text(text + "\n[effects.gamma]\ngamma = 0.9\n")
    assert refused(monday, "--on", other).startswith(
        f"{other / 'recording.toml'}: effects.gamma: differs from monday's"
    )
    (other / "recording.toml").write_text(text)
    replace_in(other / "recording.toml", "gamma = 1.0", "gamma = 1.1")
    assert refused(monday, "--on", other).startswith(f"{other / 'recording.toml'}: sensor.gamma: differs")
    (other / "recording.toml").write_text(text)
    dark = [
        line if n == 0 else ",".join([*line.split(",")[:2], "0", "0", *line.split(",")[4:]])
        for n, line in enumerate((other / "frames.csv").read_text().splitlines())
    ]
    (other / "frames.csv").write_text("\n".join(dark) + "\n")
    rows = (monday / "frames.csv").read_text().splitlines()
    (monday / "frames.csv").write_text(
        "\n".join([rows[0], *(row for row in rows[1:] if row.split(",")[2:4] != ["0", "0"])]) + "\n"
    )
    assert "has dark frames and monday arc, laser, laser and arc ones" in refused(monday, "--on", other)
    assert not (monday / "diagnosis").exists()
