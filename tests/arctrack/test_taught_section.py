"""A section taught from one frame: printed by explain, stated as a free joint, and tracked."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.errors import ArctrackError
from arctrack.nominal import nominal_setup
from arctrack.recording import BadFrame, format_setup, read_recording, read_truth
from arctrack.recording.setup_file import parse_setup
from arctrack.simulation.simulate import SimulationPlan, simulate_recording
from noise_model.arc_source import NO_ARC
from noise_model.surface.joint import Joint
from tracker.tracker import Tracker

Y_MM = np.linspace(-15.0, 15.0, 31)
HUMP_MM = tuple((float(y), 2.0 * math.exp(-(((y - 3.0) / 3.0) ** 2)) - 2.0 * math.exp(-1.0)) for y in Y_MM)


@pytest.mark.slow
def test_a_section_taught_from_a_frame_is_tracked(tmp_path: Path) -> None:
    setup = nominal_setup("v_groove", "zn_coated", width=320, height=240)
    line = setup.joint.seam_in_base_mm
    part = replace(setup, joint=Joint("free", {}, line, section_mm=HUMP_MM), arc=NO_ARC)
    plan = SimulationPlan(
        frames=6, production=True, exact=True, seam_wander_mm=0.0, weave_mm=0.5, tilt_deg=0.0
    )
    recording = simulate_recording(tmp_path / "r", part, plan)
    text = (recording / "recording.toml").read_text()
    (recording / "recording.toml").write_text(format_setup(replace(part, joint=Joint("flat", {}, line))))
    run = CliRunner().invoke(app, ["explain", str(recording), "0", "--section"])
    assert run.exit_code == 0, run.output
    assert not (recording / "results").exists()
    (taught,) = (row for row in run.stdout.splitlines() if row.startswith("section_mm = "))
    first, last = text.index("section_mm = "), text.index("seam_in_base_mm")
    stated = parse_setup(text[:first] + taught + "\n" + text[last:], recording / "recording.toml").setup
    assert stated.joint.section_mm != HUMP_MM
    read, truth, tracker = read_recording(recording), read_truth(recording), Tracker(stated)
    assert truth is not None
    poses, errors_mm = read.pose_buffer(), []
    for frame in read.frames():
        assert not isinstance(frame, BadFrame)
        track = tracker.step(frame, read.pose_at(poses, frame.timestamp_s))
        assert track.valid, track.flag_names
        errors_mm.append(np.subtract(track.seam_tool_mm, truth.seam_tool_mm[frame.index])[1:])
    assert np.abs(errors_mm).max() < 0.15


def test_an_arc_over_a_free_joint_is_refused(tmp_path: Path) -> None:
    setup = nominal_setup("v_groove", "zn_coated")
    text = format_setup(
        replace(setup, joint=Joint("free", {}, setup.joint.seam_in_base_mm, section_mm=HUMP_MM), arc=NO_ARC)
    )
    assert parse_setup(text, tmp_path / "recording.toml").setup.joint.section_mm == HUMP_MM
    arc = format_setup(setup).split("[arc]")[1].split("\n[")[0]
    with pytest.raises(ArctrackError, match=r"recording.toml: \[arc\]: leave it out"):
        parse_setup(f"{text}\n[arc]{arc}\n", tmp_path / "recording.toml")
