import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest
from mistaken import MISTAKES, edit_frames, edit_setup, edit_table, scale
from typer.testing import CliRunner

from arctrack.check.check_sample import CheckCase, case_of, chosen_rows
from arctrack.check.explanations import WeighedCause, explanations, harmless, likely_causes
from arctrack.check.findings import named_keys
from arctrack.check.hint import hint_of, likely_mistake
from arctrack.cli import app
from arctrack.cli.exit_codes import BAD_INPUT, NOTHING_TRACKED
from arctrack.errors import ArctrackError
from arctrack.nominal import DIMENSIONS, nominal_setup
from arctrack.recording.reader import read_recording
from arctrack.simulation.simulate import SimulationPlan, balance, simulate_recording
from noise_model.setup import Setup

LITTLE_SPECKLE = {"laser_speckle": {"contrast": 0.01, "grain_px": 0.5}}
ARE_VALID = "frames with the laser on are valid"
SEAM_6_MM_ABOVE = [[-100.0, 0.0, 6.5], [1000.0, 0.0, 6.5]]
SEAM_4_MM_ASIDE = [[-100.0, 4.0, 0.0], [1000.0, 4.0, 0.0]]


@pytest.fixture(scope="module")
def weaving(tmp_path_factory: pytest.TempPathFactory, seen_setup: Setup) -> Path:
    """Return a recording of two weaves, under a dim arc: the joint shows in all frames with the laser on."""
    dim = replace(seen_setup, arc=replace(seen_setup.arc, radiance_e=0.3 * seen_setup.arc.radiance_e))
    plan = SimulationPlan(frames=16, rate_hz=5.0, tilt_deg=2.0)
    return simulate_recording(tmp_path_factory.mktemp("weaving") / "v", dim, plan)


def case_from(path: Path) -> CheckCase:
    recording = read_recording(path, must_fit=False)
    positions = chosen_rows(recording)
    case = case_of(recording, positions)
    assert case is not None
    return case


@pytest.mark.slow
def test_nothing_is_wrong_with_a_sound_recording(weaving: Path) -> None:
    case = case_from(weaving)
    assert case.section_match.share > 0.9
    assert likely_mistake(case) is None


def replayed(path: Path, out: Path) -> tuple[int, str]:
    """Replay and return the exit code and what was said."""
    result = CliRunner().invoke(app, ["replay", str(path), "--no-pictures", "--out", str(out)])
    return result.exit_code, result.output


@pytest.mark.slow
def test_a_replay_ends_with_its_verdict(weaving: Path, tmp_path: Path) -> None:
    code, said = replayed(weaving, tmp_path)
    assert code == 0, said
    assert f"v: 10 of 10 offsets sent; 11 of 11 {ARE_VALID}" in said


@pytest.mark.slow
def test_a_replay_that_sees_nothing_says_what_is_wrong(weaving: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    spoil, hint = MISTAKES["tool z down"]
    spoil(path)
    code, said = replayed(path, tmp_path / "out")
    assert code == NOTHING_TRACKED, said
    assert f"; 0 of 11 frames with the laser on are valid: below_surface 11; most likely {hint}" in said
    assert (tmp_path / "out" / "results.csv").exists()


@pytest.mark.slow
def test_what_cannot_be_used_comes_before_what_sees_nothing(weaving: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    spoil, hint = MISTAKES["frames transposed"]
    spoil(path)
    code, said = replayed(path, tmp_path / "out")
    assert code == BAD_INPUT, said
    assert f"0 of 11 {ARE_VALID}: frame_unreadable 11; most likely {hint}" in said


@pytest.mark.slow
def test_a_laser_that_is_never_on(weaving: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    edit_table(path / "frames.csv", lambda row: row.update(laser_on="0"))
    code, said = replayed(path, tmp_path / "out")
    assert code == NOTHING_TRACKED, said
    assert "no frame valid: the laser is off in all 16, says frames.csv" in said


@pytest.mark.slow
def test_what_no_known_mistake_explains_is_asked_for(weaving: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    edit_frames(path, np.zeros_like)
    code, said = replayed(path, tmp_path / "out")
    assert code == NOTHING_TRACKED, said
    assert f"0 of 11 {ARE_VALID}: stripe_lost 11; do [camera] and [laser] state" in said


@pytest.mark.slow
def test_frames_that_are_valid_and_send_nothing(weaving: Path, tmp_path: Path) -> None:
    """A tolerance in m lets no offset through, though each frame shows its seam."""
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    set_key("tolerance", "seam_mm", 0.001)(path)
    code, said = replayed(path, tmp_path / "out")
    assert code == NOTHING_TRACKED, said
    assert f"r: 0 of 10 offsets sent; 11 of 11 {ARE_VALID}: low_confidence 10; " in said
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["frames"]["laser_on"], summary["offsets"]["wanted"]) == (11, 10)
    assert checked(path, tmp_path / "check.raw")[0] == NOTHING_TRACKED


@pytest.mark.slow
def test_a_seam_beyond_its_search_is_not_valid_without_a_word(weaving: Path, tmp_path: Path) -> None:
    """Coarse pixels reach farther in height than the seam is expected; the exit code stays that of a run."""
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    edit_setup(path, lambda document: document["joint"].update(seam_in_base_mm=SEAM_6_MM_ABOVE))
    code, said = replayed(path, tmp_path / "out")
    assert code == 0, said
    place = r"the seam lies 0\.[01] mm to the right of its nominal line, 6\.[0-2] mm below it"
    lies = f"{place}, and is expected within 5 mm; most likely the whole stripe lies"
    said = " ".join(said.split())
    assert len(re.findall(lies, said)) == 2
    assert re.search(f"arctrack: warning: {re.escape(str(path))}: {lies}", said)
    command = ["replay", str(path), "--no-pictures", "--resume", "--out", str(tmp_path / "out")]
    again = CliRunner().invoke(app, command).output
    assert len(re.findall(lies, " ".join(again.split()))) == 2


@pytest.mark.slow
def test_no_cure_loosens_a_tolerance_that_is_in_mm(weaving: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    edit_setup(path, lambda document: document["tolerance"].update(hand_eye_mm=50.0))
    code, said = checked(path, tmp_path / "check.raw")
    assert code == NOTHING_TRACKED, said
    assert "are the lengths and angles of [tolerance] in mm and degrees?" in said


@pytest.mark.slow
def test_no_unit_is_the_cure_of_a_setup_that_is_refused_with_it_too(weaving: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    edit_table(path / "poses.csv", scale("x_mm", -1.0))
    _, said = checked(path, tmp_path / "check.raw")
    assert "runs against the travel" in said
    assert "is in m" not in said


def checked(path: Path, out: Path) -> tuple[int, str]:
    """Check and return the exit code and what was said."""
    result = CliRunner().invoke(app, ["check", str(path), "--out", str(out)])
    assert result.exception is None or isinstance(result.exception, SystemExit | ArctrackError)
    return result.exit_code, f"{result.output}\n{result.exception}"


@pytest.mark.slow
def test_a_sound_recording_is_checked_without_a_warning(weaving: Path, tmp_path: Path) -> None:
    code, said = checked(weaving, tmp_path / "check.png")
    assert code == 0, said
    assert f"v: 10 of 10 offsets sent; 11 of 11 {ARE_VALID}" in said
    assert cv2.imread(str(tmp_path / "check.png")).shape[1] > 1000


@pytest.mark.slow
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_check_names_the_mistake(mistake: str, weaving: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    spoil, hint = MISTAKES[mistake]
    spoil(path)
    # The picture as it is drawn: to press it into a PNG takes as long.
    code, said = checked(path, tmp_path / "check.raw")
    assert code != 0, said
    assert f"most likely {hint}" in said or f" % if {hint}" in said
    assert (tmp_path / "check.raw").exists()


def set_key(table: str, key: str, factor: float) -> Callable[[Path], None]:
    def edit(document: Any) -> None:
        document[table][key] = factor * document[table][key]

    return lambda path: edit_setup(path, edit)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "warning"),
    [
        (set_key("laser", "stripe_sigma_mm", 0.7), "the stripe's width is 1 sigma"),
        (set_key("laser", "peak_e", 3.0), "the stripe's peak is"),
        (set_key("sensor", "black_level_dn", 3.0), "dark pixels read"),
        (set_key("sensor", "black_level_dn", 3.0), "[sensor] black_level_dn: The mean grey level without"),
        (set_key("sensor", "read_noise_e", 4.0), "dark pixels scatter by"),
        (set_key("arc", "radiance_e", 5.0), "the arc's light is"),
        (set_key("camera", "exposure_s", 1000.0), "recording.toml: [camera] exposure_s: exposures are"),
        (
            lambda path: edit_setup(path, lambda document: document.update(effects=LITTLE_SPECKLE)),
            "[effects.laser_speckle] states",
        ),
        (
            lambda path: edit_table(path / "frames.csv", scale("exposure_s", 1e3)),
            "frames.csv: exposure_s: exposures are 5 s in frames.csv, 0.005 s in [camera]",
        ),
        (
            lambda path: edit_table(
                path / "poses.csv", lambda row: row.update(x_mm=repr(100.0 * float(row["x_mm"])))
            ),
            "poses.csv: the tool moves at",
        ),
        (
            lambda path: edit_setup(
                path, lambda document: document["joint"].update(seam_in_base_mm=SEAM_4_MM_ASIDE)
            ),
            "the seam lies 4.",
        ),
    ],
    ids=[
        "width",
        "peak",
        "black",
        "a key that is named",
        "noise",
        "arc",
        "setup's exposure",
        "speckle",
        "exposure",
        "speed",
        "seam",
    ],
)
def test_what_parts_is_warned_of_with_numbers(
    spoil: Callable[[Path], None], warning: str, weaving: Path, tmp_path: Path
) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    spoil(path)
    _, said = checked(path, tmp_path / "check.raw")
    assert warning in said


def explained(what: str, ln_posterior: float, n_read: int) -> WeighedCause:
    """Return what explains a case of ten frames of which the tracker then reads some."""
    case = SimpleNamespace(rows=[None] * 10, n_read=n_read)
    return WeighedCause(what, f"mend {what}", cast("CheckCase", case), ln_posterior, 0.9)


AS_STATED, UNKNOWN = explained("", 0.0, 0), WeighedCause("", "", None, 5.0, 0.1)


@pytest.mark.parametrize(
    ("ranked", "said"),
    [
        ([], None),
        ([explained("", 100.0, 10), explained("lens", 99.0, 10)], None),
        ([explained("lens", 103.0, 10), explained("", 100.0, 8)], None),
        ([UNKNOWN, AS_STATED], None),
        ([explained("laser", 100.0, 10), UNKNOWN, AS_STATED], "laser; mend laser"),
        (
            [explained("laser", 100.0, 10), explained("part", 99.0, 10), UNKNOWN],
            "laser; mend laser; or else part; mend part",
        ),
        ([explained("laser", 100.0, 0), explained("part", 99.0, 10), UNKNOWN], "part; mend part"),
        (
            [explained("laser", 100.0, 4), UNKNOWN],
            "laser; with that alone mended the tracker does not read the frames: look for another mistake "
            "too",
        ),
    ],
    ids=["no case", "as stated", "nearly as stated", "unknown", "one", "two", "tried in vain", "no cure"],
)
def test_only_a_cure_that_lets_frames_be_read_is_named(ranked: list[WeighedCause], said: str | None) -> None:
    hint = hint_of(ranked)
    assert (None if hint is None else str(hint)) == said


def test_a_cure_that_loses_the_frames_is_no_cause() -> None:
    lost, kept = explained("part", 100.0, 4), explained("laser", 90.0, 5)
    read, unread = explained("", 0.0, 8), AS_STATED
    assert read.case is not None
    assert unread.case is not None
    assert harmless(read.case, [lost, kept, read]) == [kept, read]
    assert harmless(unread.case, [lost, kept, unread]) == [lost, kept, unread]


@pytest.mark.slow
def test_a_lap_that_is_stated_as_a_corrugation_may_be_a_lap(tmp_path: Path) -> None:
    """Both are one sheet upon another: a corrugation fits few lines of a lap as well as the lap does."""
    setup = balance(nominal_setup("lap", "mild_steel", width=160, height=120))
    setup = replace(setup, arc=replace(setup.arc, radiance_e=0.3 * setup.arc.radiance_e))
    plan = SimulationPlan(frames=16, rate_hz=5.0, tilt_deg=5.0, height_mm=(0.1, 6.0))
    sound = case_from(simulate_recording(tmp_path / "lap", setup, plan))
    joint = replace(setup.joint, type="corrugation", dimensions=DIMENSIONS["corrugation"])
    ranked = explanations(sound.with_setup(replace(sound.setup, joint=joint)))
    likely = [cause.what for cause in likely_causes(ranked)]
    assert "[joint] type = 'corrugation': the stripe shows a lap" in likely
    assert likely_causes(explanations(sound)) == []


def test_the_keys_that_a_line_names_are_explained() -> None:
    line = "do [laser] peak_e, [sensor] gain_e_per_dn and gamma hold? [camera] width, and [hall] light"
    keys = named_keys([line, "[sensor] gamma"])
    assert [*keys] == ["[laser] peak_e", "[sensor] gain_e_per_dn", "[sensor] gamma", "[camera] width"]
    assert keys["[camera] width"] == (
        "The image's width, px. Usual: 320 to 2048. From the data sheet. Of the frames that you record: a "
        "region of interest counts, not the whole sensor."
    )


def laser_as(state: str, only_if: Callable[[dict[str, str]], bool]) -> Callable[[Path], None]:
    """Return what states the laser's state in some rows of frames.csv."""
    return lambda path: edit_table(
        path / "frames.csv", lambda row: row.update(laser_on=state) if only_if(row) else None
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "warning"),
    [
        (laser_as("0", lambda row: row["frame"] == "1"), "frame 1 shows the stripe, though frames.csv says"),
        (laser_as("0", lambda row: True), "show the stripe, though frames.csv says laser_on = 0"),
        (
            laser_as("1", lambda row: row["arc_on"] == "0"),
            "no line, though frames.csv says laser_on = 1; correct frames.csv",
        ),
    ],
    ids=["off in a frame", "off in all", "on in the dark"],
)
def test_a_laser_that_is_not_as_stated_is_warned_of(
    spoil: Callable[[Path], None], warning: str, weaving: Path, tmp_path: Path
) -> None:
    path = Path(shutil.copytree(weaving, tmp_path / "r"))
    spoil(path)
    code, said = checked(path, tmp_path / "check.raw")
    assert code != 0
    assert warning in said


@pytest.mark.slow
def test_a_laser_that_is_as_stated_is_not_warned_of(weaving: Path, tmp_path: Path) -> None:
    _, said = checked(weaving, tmp_path / "check.png")
    (found,) = [text for text in said.splitlines() if text.startswith("laser ")]
    assert " a stripe in 0 of " in found
