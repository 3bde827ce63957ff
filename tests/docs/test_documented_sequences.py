"""What the documentation says to do improves what it says that it improves."""

from __future__ import annotations

import csv
import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from documented import run_once
from pages import ROOT, Command, steps

from arctrack.nominal import nominal_setup
from arctrack.recording import read_recording
from arctrack.replay.replay import ReplayOptions, replay_recording
from arctrack.simulation.simulate import SimulationPlan, balance, simulate_recording
from noise_model.surface.brdf import TABLE_1

pytestmark = pytest.mark.slow


def commands(page: str, section: str) -> list[str]:
    """Return the commands of a section of a page that name no recording of the reader's own."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    part = re.split(r"^## ", text, flags=re.MULTILINE)
    (of_section,) = (lines for lines in part if lines.startswith(section))
    return [step.text for step in steps(ROOT / "docs" / page) if _is_in(step, of_section)]


def _is_in(step: object, section: str) -> bool:
    joined = " ".join(section.replace("\\\n", " ").split())
    return isinstance(step, Command) and step.text in joined


def errors_mm(folder: Path) -> dict[str, Any]:
    """Return the seam's errors that a replay has written."""
    return dict(json.loads((folder / "summary.json").read_text())["error_mm"])


def total_mm(folder: Path) -> float:
    """Return the RMS of the seam's error, lateral and vertical together."""
    errors = errors_mm(folder)
    return math.hypot(errors["lateral"]["rms"], errors["vertical"]["rms"])


def test_a_hand_eye_calibration_brings_the_seam_nearer_to_the_true_one(scratch: Path, shared: Path) -> None:
    sequence = commands("how_to/calibrate.md", "arctrack calibrate hand-eye")
    assert [command.split()[1] for command in sequence] == ["simulate", "replay", "calibrate", "replay"]
    outputs = [run_once(command, scratch, shared) for command in sequence]
    expected = [
        [float(number) for number in re.findall(r"([\d.]+) mm", line)]
        for line in outputs[2].splitlines()
        if line.split()[:1] in (["lateral"], ["vertical"])
    ]
    before_mm, after_mm = (math.hypot(*axes) for axes in zip(*expected, strict=True))
    assert after_mm < 0.7 * before_mm
    true_before_mm, true_after_mm = (total_mm(scratch / "tmp" / name) for name in ("before", "after"))
    assert true_before_mm > 0.3
    assert true_after_mm < 0.3 * true_before_mm
    assert true_after_mm < 2.0 * after_mm


def test_the_arc_map_steadies_the_height(scratch: Path, shared: Path) -> None:
    sequence = commands("tutorial/first_hour.md", "Do without the arc map")
    (without,) = sequence
    (with_map,) = commands("tutorial/first_hour.md", "Track a recording")
    for command in (with_map, without):
        run_once(command, scratch, shared)
    steady_mm, bare_mm = (
        errors_mm(scratch / "tmp" / name)["vertical"]["with_constant_part_removed"]["rms"]
        for name in ("results", "without")
    )
    assert steady_mm < 0.5 * bare_mm


def test_a_goniometers_readings_give_the_metal_back(scratch: Path, shared: Path) -> None:
    (command,) = commands("how_to/calibrate.md", "arctrack calibrate reflectance")
    run_once(command, scratch, shared)
    found = tomllib.loads((scratch / "tmp" / "steel" / "material.toml").read_text())["material"]
    for name in ("kappa_diff", "kappa_spec", "c2"):
        assert found[name] == pytest.approx(getattr(TABLE_1["mild_steel"], name), rel=0.02)


def arc_level(recording: Path, folder: Path) -> float:
    """Return the median of the column that own_sensor.md tells to correct the arc's radiance by."""
    replay_recording(read_recording(recording), folder, ReplayOptions(pictures=False))
    with (folder / "results.csv").open() as file:
        levels = [float(row["arc_level"]) for row in csv.DictReader(file) if row["arc_level"]]
    return float(np.median(levels))


def test_an_arcs_level_is_right_after_one_correction(tmp_path: Path) -> None:
    setup = balance(nominal_setup("v_groove", "mild_steel", width=160, height=120))
    path = simulate_recording(tmp_path / "sensor", setup, SimulationPlan(frames=14, exact=True))
    file = path / "recording.toml"
    true = f"radiance_e = {setup.arc.radiance_e}"
    assert true in file.read_text()
    stated = 0.6 * setup.arc.radiance_e
    file.write_text(file.read_text().replace(true, f"radiance_e = {stated}"))
    level = arc_level(path, tmp_path / "first")
    assert level > 1.4
    corrected = file.read_text().replace(f"radiance_e = {stated}", f"radiance_e = {stated * level}")
    file.write_text(corrected)
    assert arc_level(path, tmp_path / "second") == pytest.approx(1.0, abs=0.05)
