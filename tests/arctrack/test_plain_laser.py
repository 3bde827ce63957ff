"""A plain laser tracker: a setup without arc, filter and metal, through every command."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from spoiled import Refusal
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.nominal import nominal_setup
from arctrack.recording import format_setup, read_recording, read_setup_file
from arctrack.simulation.simulate import SimulationPlan, simulate_recording
from noise_model.arc_source import NO_ARC
from noise_model.condition import Condition
from noise_model.effects import REGISTRY, checked
from noise_model.forward import predict
from noise_model.plan.noise import expected_speckle
from noise_model.setup import Setup
from noise_model.surface.brdf import UNSTATED_METAL, Material

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})
BOTH = Condition(1.0, 1.0, 0.005)


@pytest.fixture(scope="module")
def plain() -> Setup:
    setup = nominal_setup("v_groove", "zn_coated", width=160, height=120)
    return replace(setup, arc=NO_ARC, filter=None, material=UNSTATED_METAL)


@pytest.fixture(scope="module")
def path(plain: Setup, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording whose speckle is stated; tests copy it before they write into it."""
    speckled = replace(plain, effects={"laser_speckle": expected_speckle(plain)})
    return simulate_recording(
        tmp_path_factory.mktemp("plain") / "r", speckled, SimulationPlan(frames=14, tilt_deg=2.0)
    )


def run(*arguments: object) -> tuple[int, str]:
    result = RUNNER.invoke(app, [str(argument) for argument in arguments])
    return result.exit_code, result.output


def arc_levels(out: Path) -> tuple[list[str], int]:
    """Return the arc's levels as they are written, and the number of valid frames."""
    with (out / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [row["arc_level"] for row in rows], sum(row["valid"] == "1" for row in rows)


def test_a_file_states_only_what_is_known(plain: Setup, tmp_path: Path) -> None:
    file = tmp_path / "recording.toml"
    text = format_setup(plain)
    file.write_text(text)
    stated = read_setup_file(file)
    assert stated.setup.missing == ("arc", "filter", "material")
    assert stated.unknown_keys == ()
    assert format_setup(stated.setup) == text
    assert not {"[arc]", "[filter]", "[material]"} & set(text.splitlines())
    assert "no arc" in str(stated.setup)
    assert "kappa" not in str(stated.setup)


def test_its_stripe_is_that_of_any_even_metal(plain: Setup) -> None:
    dull = replace(plain, material=Material("dull", 0.3, 0.0, 5.0))
    # Light is counted in single precision: the last digits depend on the metal's own scale.
    np.testing.assert_allclose(
        predict(plain, np.eye(4), BOTH).mean_e, predict(dull, np.eye(4), BOTH).mean_e, rtol=1e-6
    )
    laser_off = Condition(0.0, 1.0, 0.005)
    assert not predict(plain, np.eye(4), laser_off).mean_e.any()


@pytest.mark.slow
@pytest.mark.parametrize("name", REGISTRY)
def test_effects_act_or_say_what_they_need(name: str, plain: Setup) -> None:
    effect = REGISTRY[name]
    if effect.needs:
        with pytest.raises(ValueError, match=rf"^\[effects\.{name}\]: needs \[{effect.needs[0]}\]"):
            checked({name: effect.typical}, plain.joint, plain.missing)
        return
    effects = checked({name: effect.typical}, plain.joint, plain.missing)
    pixels = np.arange(0, 160 * 120, 97)
    seen = predict(replace(plain, effects=effects), np.eye(4), BOTH, pixels=pixels)
    assert np.isfinite(seen.mean_e).all()


@pytest.mark.slow
def test_it_tracks(path: Path, tmp_path: Path) -> None:
    code, said = run("replay", path, "--out", tmp_path / "out")
    assert code == 0, said
    levels, valid = arc_levels(tmp_path / "out")
    lit = [row for row in read_recording(path).rows if row.laser_on]
    assert set(levels) == {""}
    assert valid == len(lit) > 6
    assert not any(row.arc_on for row in lit)


@pytest.mark.slow
def test_an_arc_that_is_not_stated_is_light_of_the_hall(path: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(path, tmp_path / "r"))
    frames = (copy / "frames.csv").read_text()
    (copy / "frames.csv").write_text(frames.replace(",1,0,0,", ",1,1,100,"))
    code, said = run("replay", copy, "--out", tmp_path / "out", "--no-pictures")
    assert code == 0, said
    assert set(arc_levels(tmp_path / "out")[0]) == {""}
    _, said = run("check", copy, "--out", tmp_path / "check.png")
    assert "[arc] is missing, though frames.csv says arc_on" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("check", "no offset was wanted"),
        ("explain", "There is no arc light"),
        ("inspect", "an unstated metal"),
    ],
)
def test_commands_that_need_no_arc(command: str, said: str, path: Path, tmp_path: Path) -> None:
    name = {"check": "c.png", "explain": "e.html", "inspect": "i.png"}[command]
    frame = ["6"] if command == "explain" else []
    code, output = run(command, path, *frame, "--out", tmp_path / name)
    assert code == 0, output
    assert said in output


@pytest.mark.parametrize(
    ("command", "missing"),
    [
        (("plan",), "[arc], [filter], [material] are missing: a plan needs"),
        (("calibrate", "hand-eye"), "[arc], [material] are missing: the hand-eye estimate needs"),
    ],
)
def test_commands_that_need_more_say_what(
    command: tuple[str, ...], missing: str, path: Path, tmp_path: Path, refusal: Refusal
) -> None:
    assert missing in refusal(*command, path, "--out", tmp_path / "out")


def test_the_diagnosis_of_frames_with_an_arc_needs_what_the_arc_does(
    path: Path, tmp_path: Path, refusal: Refusal
) -> None:
    copy = Path(shutil.copytree(path, tmp_path / "r"))
    frames = (copy / "frames.csv").read_text()
    (copy / "frames.csv").write_text(frames.replace(",1,0,0,", ",1,1,100,"))
    said = refusal("diagnose", copy, "--out", tmp_path / "out")
    assert f"{copy}: [arc], [filter], [material] are missing: the diagnosis of the " in said
    assert " frames whose arc_on is 1 in frames.csv needs them; state them" in said


@pytest.mark.slow
def test_it_is_diagnosed(path: Path, tmp_path: Path) -> None:
    code, said = run("diagnose", path, "--out", tmp_path / "out")
    assert code == 0, said
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["verdict"] == "no_gap"
    ranked = {candidate["id"] for candidate in report["ranking"]}
    assert not ranked & {name for name, effect in REGISTRY.items() if effect.needs}
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Left out of the catalogue: arc_length," in page


def test_a_filters_curve_needs_its_index(path: Path, tmp_path: Path, refusal: Refusal) -> None:
    curve = tmp_path / "curve.csv"
    nm = np.linspace(670.0, 710.0, 41)
    table = np.column_stack([nm, np.exp(-(((nm - 690.0) / 6.0) ** 2))])
    np.savetxt(curve, table, delimiter=",", header="wavelength_nm,transmission", comments="")
    out = tmp_path / "recording.toml"
    said = refusal("calibrate", "filter", curve, "--setup", path, "--out", out)
    assert "[filter] is missing: give --effective-index" in said
    code, said = run("calibrate", "filter", curve, "--setup", path, "--out", out, "--effective-index", 1.8)
    assert code == 0, said
    assert read_setup_file(out).setup.missing == ("arc", "material")
