"""`arctrack calibrate arc`: an arc that is not as stated is found, what frames do not tell is refused."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from arctrack.calibrate.arc.stage import arc_stage
from arctrack.calibrate.stage import Tell
from arctrack.cli import app
from arctrack.errors import ArctrackError
from arctrack.recording import Recording, read_recording, read_setup_file
from calibration.arc.calibrate import KEYS

RUNNER = CliRunner(env={"COLUMNS": "160", "TERM": "dumb", "NO_COLOR": "1"})

pytestmark = pytest.mark.slow


def no_steps(what: str, unit: str) -> Tell:
    """Begin a step that nobody watches."""
    return lambda done, total: None


def with_arc(recording: Recording, **changes: object) -> Recording:
    setup = recording.setup
    return replace(recording, setup=replace(setup, arc=replace(setup.arc, **changes)))


def test_a_misstated_arc_is_found_within_its_sigmas(simulated: Path) -> None:
    read = read_recording(simulated)
    arc = read.setup.arc
    stage = arc_stage(with_arc(read, radiance_e=0.5 * arc.radiance_e), no_steps)
    result = stage.result
    truth = [arc.radius_mm, *arc.center_in_tool_mm, arc.radiance_e]
    assert stage.bad_frames == []
    off = (result.values[:5] - truth) / result.sigmas[:5]
    assert np.abs(off).max() < 4.0
    assert result.values[4] == pytest.approx(arc.radiance_e, rel=0.3)
    # Neither frames nor the sum of the kappas tell a lobe that none of them mirrors.
    assert "ln_c2" in result.refused
    assert result.setup.material.c2 == read.setup.material.c2


def test_the_command_writes_what_was_told_and_keeps_the_rest(simulated: Path, tmp_path: Path) -> None:
    out = tmp_path / "recording.toml"
    result = RUNNER.invoke(app, ["calibrate", "arc", str(simulated), "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "c2: refused" in result.output
    assert read_setup_file(out).setup.material == read_setup_file(simulated / "recording.toml").setup.material
    record = tomllib.loads(out.read_text())["calibration"]["arc"]
    assert record["parameters"] == [*KEYS[:4], "radiance_rel"]
    assert "c2" in record["held_as_stated"]
    assert "hardly tell" in (tmp_path / "calibrate_arc.html").read_text()


def test_a_recording_without_frames_of_the_arc_alone_is_refused(simulated: Path) -> None:
    read = read_recording(simulated)
    lit = replace(read, rows=tuple(row for row in read.rows if row.laser_on))
    with pytest.raises(ArctrackError, match="no frame has the arc on, the laser off"):
        arc_stage(lit, no_steps)
