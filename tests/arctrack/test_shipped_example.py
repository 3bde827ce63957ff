"""The shipped example is what the documented command makes by the present model, and it has no gap."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from documented import run_once

from arctrack.recording import Recording, read_recording, read_truth
from noise_model.compiled.arrays import Float64
from noise_model.instrument.sensor import electrons_per_dn, linearise, variance_e2
from tracker.state import Frame

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "v_groove"
BLOCK_PX = 16


def documented_command() -> str:
    """Return the command that docs/reference/commands.md gives for the example."""
    text = (ROOT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"^arctrack simulate /tmp/v_groove .*$", text, re.MULTILINE)
    return str(command)


def frames_of(recording: Recording) -> list[Frame]:
    return [frame for frame in recording.frames() if isinstance(frame, Frame)]


def block_scores(shipped: Frame, made: Frame, recording: Recording) -> Float64:
    """Return by how many of its sigmas each block's mean differs between two draws of noise."""
    sensor = recording.setup.sensor
    charge_e = linearise(made.image_dn, sensor)
    variance_dn2 = variance_e2(charge_e, sensor) / electrons_per_dn(charge_e, sensor) ** 2
    difference_dn = shipped.image_dn.astype(np.float64) - made.image_dn

    def block_mean(image: Float64) -> Float64:
        rows, columns = image.shape
        return image.reshape(rows // BLOCK_PX, BLOCK_PX, columns // BLOCK_PX, BLOCK_PX).mean(axis=(1, 3))

    sigma_dn = np.sqrt(2.0 * block_mean(variance_dn2)) / BLOCK_PX
    return np.asarray(block_mean(difference_dn) / sigma_dn)


@pytest.mark.slow
def test_the_documented_command_makes_the_shipped_example(scratch: Path, shared: Path) -> None:
    run_once(documented_command(), scratch, shared)
    remade = scratch / "tmp" / "v_groove"
    shipped, made = read_recording(EXAMPLE), read_recording(remade)
    assert (EXAMPLE / "recording.toml").read_text() == (remade / "recording.toml").read_text()
    assert (EXAMPLE / "frames.csv").read_text() == (remade / "frames.csv").read_text()
    for name, within in (("poses.csv", 2e-6), ("truth.csv", 2e-5)):
        ours, theirs = (np.loadtxt(path / name, delimiter=",", skiprows=1) for path in (EXAMPLE, remade))
        np.testing.assert_allclose(ours, theirs, atol=within, rtol=0.0)
    pairs = list(zip(frames_of(shipped), frames_of(made), strict=True))
    assert len(pairs) == 24
    # On the processor that made it all pixels are the same. On others light differs in its last bits: where
    # that turns a draw of the noise, all later draws are others, and only the expected light stays.
    for ours, theirs in pairs:
        score = block_scores(ours, theirs, shipped)
        assert np.abs(score).max() < 6.0, f"frame {ours.index}"
        assert np.mean(score**2) < 1.25, f"frame {ours.index}"


def test_the_shipped_example_has_all_conditions() -> None:
    recording = read_recording(EXAMPLE)
    frames = frames_of(recording)
    switches = {(frame.laser_on, frame.arc_on) for frame in frames}
    assert switches == {(False, False), (True, False), (False, True), (True, True)}
    assert {frame.current_a for frame in frames if frame.arc_on} == {100.0, 140.0}
    assert {frame.exposure_s for frame in frames} == {0.005, 0.0025}
    truth = read_truth(EXAMPLE)
    assert truth is not None
    assert list(truth.frames) == [frame.index for frame in frames]


@pytest.mark.slow
def test_the_shipped_example_has_no_gap(scratch: Path, shared: Path) -> None:
    output = run_once("arctrack diagnose examples/v_groove --out /tmp/diagnosis", scratch, shared)
    assert "No gap" in output
    report = json.loads((scratch / "tmp" / "diagnosis" / "report.json").read_text())
    assert report["verdict"] == "no_gap"
    assert report["effects"] == []
    assert report["gap"]["before"] < report["gap"]["floor"]
