import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mistaken import MISTAKES, edit_frames, edit_table
from typer.testing import CliRunner

from arctrack.check.case import Case, case_of, chosen_rows
from arctrack.check.hint import likely_mistake
from arctrack.cli import BAD_INPUT, NOTHING_TRACKED, app
from arctrack.recording.reader import read_recording
from arctrack.simulate import SimulationPlan, simulate_recording
from noise_model.setup import Setup


@pytest.fixture(scope="module")
def weaving(tmp_path_factory: pytest.TempPathFactory, seen_setup: Setup) -> Path:
    """Return a recording of two weaves, under a dim arc: the joint shows in all frames with the laser on."""
    dim = replace(seen_setup, arc=replace(seen_setup.arc, radiance_e=0.3 * seen_setup.arc.radiance_e))
    plan = SimulationPlan(frames=16, rate_hz=5.0, tilt_deg=2.0)
    return simulate_recording(tmp_path_factory.mktemp("weaving") / "v", dim, plan)


def case_from(path: Path) -> Case:
    recording = read_recording(path, must_fit=False)
    positions = chosen_rows(recording)
    case = case_of(recording, positions, list(recording.images(positions)))
    assert case is not None
    return case


def test_nothing_is_wrong_with_a_sound_recording(weaving: Path) -> None:
    case = case_from(weaving)
    assert case.fit().share > 0.9
    assert likely_mistake(case) is None


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_hint_names_the_mistake(mistake: str, weaving: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    spoil, said = MISTAKES[mistake]
    spoil(path)
    hint = likely_mistake(case_from(path))
    assert hint is not None
    assert str(hint).startswith(said)


def replayed(path: Path, out: Path) -> tuple[int, str]:
    """Replay and return the exit code and what was said."""
    result = CliRunner().invoke(app, ["replay", str(path), "--no-pictures", "--out", str(out)])
    return result.exit_code, result.output


def test_a_replay_ends_with_its_verdict(weaving: Path, tmp_path: Path) -> None:
    code, said = replayed(weaving, tmp_path)
    assert code == 0, said
    assert "v: tracked: 11 of 11 frames with the laser on are valid" in said


def test_a_replay_that_sees_nothing_says_what_is_wrong(weaving: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    spoil, hint = MISTAKES["tool z down"]
    spoil(path)
    code, said = replayed(path, tmp_path / "out")
    assert code == NOTHING_TRACKED, said
    assert f"r: no frame valid: below_surface 11; most likely {hint}" in said
    assert (tmp_path / "out" / "results.csv").exists()


def test_what_cannot_be_used_comes_before_what_sees_nothing(weaving: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    spoil, hint = MISTAKES["frames transposed"]
    spoil(path)
    code, said = replayed(path, tmp_path / "out")
    assert code == BAD_INPUT, said
    assert f"no frame valid: frame_unreadable 11; most likely {hint}" in said


def test_a_laser_that_is_never_on(weaving: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    edit_table(path / "frames.csv", lambda row: row.update(laser_on="0"))
    code, said = replayed(path, tmp_path / "out")
    assert code == NOTHING_TRACKED, said
    assert "no frame valid: the laser is off in all 16, says frames.csv" in said


def test_what_no_known_mistake_explains_is_asked_for(weaving: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    edit_frames(path, np.zeros_like)
    code, said = replayed(path, tmp_path / "out")
    assert code == NOTHING_TRACKED, said
    assert "no frame valid: stripe_lost 11; do [camera] and [laser] state where" in said
