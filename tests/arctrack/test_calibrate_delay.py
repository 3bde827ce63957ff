import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from documented import run_once
from typer.testing import CliRunner

from arctrack import cli
from arctrack.errors import ArctrackError
from arctrack.recording import read_setup_file
from calibration.pose_delay import PoseDelay
from tracker.seam_observations import SeamObservations

EXAMPLE = Path(__file__).parents[2] / "examples" / "v_groove"
RUNNER = CliRunner(env={"COLUMNS": "160", "TERM": "dumb", "NO_COLOR": "1"})


@pytest.mark.slow
def test_the_example_has_no_delay_within_its_sigma(scratch: Path, shared: Path) -> None:
    command = "arctrack calibrate delay examples/v_groove --out /tmp/in_time.toml"
    output = run_once(command, scratch, shared)
    out = scratch / "tmp" / "in_time.toml"
    record = tomllib.loads(out.read_text())["calibration"]["pose_delay"]
    delay_s = read_setup_file(out).setup.effects["pose_delay"]["delay_s"]
    assert abs(delay_s) < 3.5 * record["sigma"][0] < 0.02
    assert "delay of the poses' clock" in output
    page = (out.parent / "calibrate_delay.html").read_text()
    assert page.count("data:image/svg+xml") == 2
    assert "beyond the tracker&#39;s own sigmas" in page


@pytest.mark.slow
def test_what_is_not_known_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = PoseDelay(
        0.01,
        0.2,
        None,
        np.array([-0.1, 0.01, 0.1]),
        np.array([-0.5, 0.0, -0.2]),
        SeamObservations(np.empty((0, 2)), np.empty(0), np.empty((0, 2)), ()),
        np.array([1.0, 0.02]),
        np.array([0.04, 0.04]),
        0.1,
    )
    weak = replace(known, unestimated="the motion is too weak: weave it")
    monkeypatch.setattr("arctrack.calibrate.delay.stage.estimate_pose_delay", lambda *_: weak)
    out = tmp_path / "recording.toml"
    result = RUNNER.invoke(cli.app, ["calibrate", "delay", str(EXAMPLE), "--out", str(out)])
    assert isinstance(result.exception, ArctrackError)
    assert "the delay is unestimated: the motion is too weak" in str(result.exception)
    assert not out.exists()
    page = (tmp_path / "calibrate_delay.html").read_text()
    assert "The delay is unestimated" in page
    assert "<h2>Values</h2>" not in page
