"""`arctrack calibrate check`: a sound setup explains its recording, a wrong one is named by its stage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from browser import Page
from typer.testing import CliRunner

from arctrack.calibrate.check.check_setup import SetupCheck, check_setup
from arctrack.calibrate.check.measure import LightStage, Measure, SetupVerdict, judged
from arctrack.check.check_recording import check_recording
from arctrack.cli import app
from arctrack.cli.exit_codes import WARNED
from arctrack.recording import read_recording
from calibration.check.stripe_place import with_changes

RUNNER = CliRunner(env={"COLUMNS": "160", "TERM": "dumb", "NO_COLOR": "1"})

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def checked(simulated: Path) -> SetupCheck:
    return check_setup(read_recording(simulated, must_fit=False))


def test_a_setup_explains_what_was_simulated_with_it(checked: SetupCheck) -> None:
    assert checked.not_explained == ()
    assert {stage for stage in LightStage if checked.verdict_of(stage) is SetupVerdict.OK} == set(LightStage)


def test_the_arc_of_a_setup_that_is_too_dim_is_named(simulated: Path, checked: SetupCheck) -> None:
    recording = read_recording(simulated, must_fit=False)
    arc = replace(recording.setup.arc, radiance_e=0.5 * recording.setup.arc.radiance_e)
    dim = check_setup(replace(recording, setup=replace(recording.setup, arc=arc)))
    assert dim.not_explained == (LightStage.ARC,)
    assert checked.arc is not None
    assert dim.arc is not None
    assert dim.arc.level.value == pytest.approx(2.0 * checked.arc.level.value, rel=0.02)


def test_a_stale_sheet_is_named_as_arctrack_check_names_it(simulated: Path) -> None:
    recording = read_recording(simulated, must_fit=False)
    stale = replace(recording, setup=with_changes(recording.setup, {"laser_offset": 3.0}))
    seen = check_setup(stale)
    assert LightStage.PLACE in seen.not_explained
    hint = check_recording(stale).hint
    assert hint is not None
    assert hint.what.partition("px off its place: ")[2].startswith("[laser] plane_in_tool is")
    assert "arctrack calibrate sheet corrects it" in hint.cure
    assert hint.what in seen.headline
    assert f"To do: {hint.cure}." in seen.sentences


def test_the_command_says_what_to_do_and_writes_a_page(
    simulated: Path, tmp_path: Path, browser: Page
) -> None:
    text = (simulated / "recording.toml").read_text()
    black = next(line for line in text.splitlines() if line.startswith("black_level_dn"))
    setup = tmp_path / "recording.toml"
    setup.write_text(text.replace(black, "black_level_dn = 9.0"))
    page = tmp_path / "check.html"
    command = ["calibrate", "check", str(setup), str(simulated), "--report", str(page)]
    result = RUNNER.invoke(app, command)
    assert result.exit_code == WARNED, result.output
    assert "black level in dark frames: arctrack calibrate sensor" in result.output
    assert "the setup does not explain the recording: sensor: black level" in result.output
    html = page.read_text()
    assert html.count("data:image/svg+xml") == 2
    assert "<h2>sensor: does not explain</h2>" in html
    browser.open(page)
    browser.assert_readable()


def test_a_page_does_not_replace_the_setup(simulated: Path) -> None:
    setup = simulated / "recording.toml"
    command = ["calibrate", "check", str(setup), str(simulated), "--report", str(setup)]
    result = RUNNER.invoke(app, command)
    assert result.exception is not None
    assert "is the setup's file" in str(result.exception)


@pytest.mark.parametrize(
    ("measured", "sigma", "verdict"),
    [
        (1.29, 0.1, SetupVerdict.OK),
        (1.31, 0.1, SetupVerdict.NOT_EXPLAINED),
        (float("nan"), 0.1, SetupVerdict.UNTOLD),
        (1.31, float("nan"), SetupVerdict.UNTOLD),
    ],
)
def test_three_sigmas_are_the_limit(measured: float, sigma: float, verdict: SetupVerdict) -> None:
    assert judged(LightStage.ARC, "level", measured, 1.0, sigma, "", "").verdict is verdict


def test_what_is_not_known_is_left_empty() -> None:
    nan = float("nan")
    assert Measure(LightStage.ARC, "level", nan, 1.0, nan, "", SetupVerdict.UNTOLD).shown == ("", "1", "")
