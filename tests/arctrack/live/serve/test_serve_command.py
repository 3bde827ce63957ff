"""`arctrack serve`: what it says, and what it refuses."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
import tomlkit
from made import playing_cell
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.cli.exit_codes import NOTHING_TRACKED
from arctrack.control.cell_file.new import write_new_cell
from arctrack.errors import ArctrackError
from arctrack.live.cameras.shared_frames import SharedFramesWriter
from arctrack.live.serve.simulated import write_simulated_cell
from arctrack.simulation.cell.weld.closed_loop import LoopPlan, setup_of


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
def test_a_recording_is_served_at_its_pace(simulated: Path, tmp_path: Path) -> None:
    cell = playing_cell(tmp_path / "cell", simulated)
    document = tomlkit.parse(cell.read_text())
    document["process"]["cpus"] = [4095]
    cell.write_text(tomlkit.dumps(document))
    done = CliRunner().invoke(app, ["serve", str(cell)])
    assert done.exit_code == 0, done.output
    assert "[process] cpus = [4095]: " in done.stderr
    ready, count, frames, offsets, *late = done.stdout.splitlines()
    assert ready == f"ready: recording {simulated}, bus virtual:{cell.parent}; Ctrl-C ends it"
    tracked, dropped = map(int, re.match(r"frames: (\d+), dropped (\d+), tracks valid", frames).groups())
    assert tracked + dropped == 14
    assert count == "no offset was wanted"
    assert offsets.startswith("offsets: REFUSED ")
    assert [line.split(":")[0] for line in late] == ["mid-exposure to send", "arrival to send"]


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
def test_a_run_that_no_robot_could_follow_ends_with_3(tmp_path: Path) -> None:
    plan = LoopPlan(joint="lap", length_mm=1000.0, rate_hz=10.0, size_px=(160, 120))
    name = f"unfollowed-{os.getpid()}"
    cell = write_simulated_cell(tmp_path / "cell", plan, "virtual", name, name)
    with SharedFramesWriter(name, 120, 160, setup_of(plan).sensor.dtype):
        done = CliRunner().invoke(app, ["serve", str(cell), "--seconds", "0.1"])
    assert done.exit_code == NOTHING_TRACKED, done.output
    assert "offsets: REFUSED " in done.stdout


def test_what_cannot_be_served_is_named(tmp_path: Path) -> None:
    cell, _ = write_new_cell(tmp_path / "cell", "v_groove", "mild_steel")
    document = tomlkit.parse(cell.read_text())
    document["camera"].update({"kind": "shared_memory", "name": "nobody-publishes-this"})
    live = cell.with_name("live.toml")
    live.write_text(tomlkit.dumps(document))
    for words, complaint in (
        ([], "serve: give a cell file, or --simulated"),
        ([str(cell), "--simulated"], "serve: give a cell file, or --simulated"),
        ([str(cell)], f"{cell}: [camera] kind: missing; state kind and name"),
        ([str(live)], f"{live}: [camera] name: frames 'nobody-publishes-this': nobody publishes them; start"),
        ([str(live), "--job", "1"], "--job 1: a live robot names its job itself; leave it out"),
    ):
        done = CliRunner().invoke(app, ["serve", *words])
        assert isinstance(done.exception, ArctrackError), words
        assert str(done.exception).startswith(complaint)


@pytest.mark.slow
def test_a_bus_that_there_is_not_is_named(simulated: Path, tmp_path: Path) -> None:
    cell = playing_cell(tmp_path / "cell", simulated)
    document = tomlkit.parse(cell.read_text())
    document["bus"]["interface"] = "nosuch"
    cell.write_text(tomlkit.dumps(document))
    done = CliRunner().invoke(app, ["serve", str(cell)])
    assert str(done.exception).startswith(f"{cell}: [bus] CAN nosuch:{cell.parent}: cannot open ")
