"""A profiler's recording is simulated, replayed, checked and shared as one of images is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from profiler_setup import profiler_setup
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.errors import ArctrackError
from arctrack.live.cameras.shared_frames import SharedFramesWriter
from arctrack.live.cameras.shared_memory import SharedMemoryCamera
from arctrack.live.doctor.steps import time_steps
from arctrack.recording import BadFrame, format_setup, read_recording, read_setup_file
from arctrack.recording.setup_file import parse_setup
from tracker.state import Frame
from tracker.tracker import Tracker

RUNNER = CliRunner(env={"COLUMNS": "200", "TERM": "dumb", "NO_COLOR": "1"})
SETUP = profiler_setup(640, 0.06, range_mm=30.0, depth_mm=6.0, root_gap_mm=1.0)
V_GROOVE = 'type = "v_groove"\nincluded_angle_deg = 60.0\ndepth_mm = 6.0\nroot_gap_mm = 1.0\n'
CORRUGATION = 'type = "corrugation"\nthickness_mm = 2.0\nheight_mm = 6.0\nwidth_mm = 30.0\npitch_mm = 60.0\n'


def run(*arguments: object) -> None:
    done = RUNNER.invoke(app, [*map(str, arguments)])
    assert done.exit_code == 0, done.output


def test_a_setup_reads_back_as_it_was_written(tmp_path: Path) -> None:
    setup = parse_setup(SETUP, tmp_path / "recording.toml").setup
    text = format_setup(setup)
    assert format_setup(parse_setup(text, tmp_path / "again.toml").setup) == text
    assert "[sensor]" not in text


@pytest.mark.parametrize(
    ("stated", "instead", "problem"),
    [
        ("columns = 640\n", "", r"\[camera\] columns: missing"),
        ('"profile"', '"profiles"', r"\[camera\] kind = .*must be 'profile'"),
        ("pitch_mm = 0.06", "pitch_mm = 0.001", r"\[camera\] range_mm = 30: must be 16384 pitch_mm at most"),
    ],
)
def test_a_wrong_key_is_named(tmp_path: Path, stated: str, instead: str, problem: str) -> None:
    assert stated in SETUP
    with pytest.raises(ArctrackError, match=problem):
        parse_setup(SETUP.replace(stated, instead), tmp_path / "recording.toml")


def test_frames_go_through_shared_memory(tmp_path: Path) -> None:
    (tmp_path / "recording.toml").write_text(SETUP)
    setup, name = read_setup_file(tmp_path / "recording.toml").setup, f"profiles-{tmp_path.name}"
    image = np.random.default_rng(0).integers(0, 65536, (2, 640), dtype=np.uint16)
    with SharedFramesWriter(name, *setup.frame_shape, setup.sensor.dtype) as frames:
        camera = SharedMemoryCamera(name, setup)
        frames.publish(Frame(7, 0.1, image, 0.001))
        frame = camera.newest()
        assert isinstance(frame, Frame)
        np.testing.assert_array_equal(frame.image_dn, image)
        camera.close()


@pytest.mark.slow
@pytest.mark.parametrize("joint", [V_GROOVE, CORRUGATION])
def test_a_recording_is_simulated_replayed_and_checked(tmp_path: Path, joint: str) -> None:
    assert V_GROOVE in SETUP
    (tmp_path / "recording.toml").write_text(SETUP.replace(V_GROOVE, joint))
    made = tmp_path / "made"
    run("simulate", made, "--setup", tmp_path / "recording.toml", "--frames", 4, "--production", "--exact")
    assert not any(isinstance(frame, BadFrame) for frame in read_recording(made).frames())
    run("replay", made)
    summary = json.loads((made / "results" / "summary.json").read_text())
    assert summary["frames"]["valid"] == 4
    page = (made / "results" / "replay.html").read_text()
    assert '"shows_light":false' in page
    assert "brightness by" not in page
    run("check", made)
    problem = f'{made / "recording.toml"}: [camera] kind = "profile": this reads images alone'
    for command in ("explain {} 1", "diagnose {}", "calibrate check {} {}", "calibrate sheet {}", "plan {}"):
        done = RUNNER.invoke(app, command.format(made, made).split())
        assert done.exit_code != 0, command
        assert problem in f"{done.exception} {done.output}", command


@pytest.mark.slow
def test_the_doctor_times_steps_on_profiles(tmp_path: Path) -> None:
    setup = parse_setup(SETUP, tmp_path / "recording.toml").setup
    assert time_steps(Tracker(setup), 16, lambda _: None).valid_share == 1.0
