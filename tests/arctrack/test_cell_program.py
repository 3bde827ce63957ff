"""A recording's pass kept, followed again in a replay, and written as the next pass's program."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from arctrack.check.verdict import verdict_on
from arctrack.cli import app
from arctrack.control.cell_file import read_cell_file
from arctrack.control.cell_file.job_setup import job_setup_text
from arctrack.control.cell_file.new import write_new_cell
from arctrack.recording import read_recording
from arctrack.recording.seam_file import read_seam
from arctrack.recording.setup_file import parse_setup
from arctrack.replay.replay import Replay, ReplayOptions, replay_recording
from arctrack.replays import made_of

EXAMPLE = Path(__file__).parents[2] / "examples" / "v_groove"
PASSES = """
[jobs.2]
name = "fill"
schedule = "schedule.csv"
[jobs.2.again]
seam = "root.json"
side_mm = 1.5
height_mm = 1.0
laser = false
[jobs.2.follow.y]
bias_mm = 0.25

[jobs.3]
name = "cap, back"
[jobs.3.again]
seam = "root.json"
side_mm = 2.0
tilt_deg = 10.0
reverse = true
"""


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cell whose first job's pass, that of the example, is kept."""
    path, setup = write_new_cell(tmp_path_factory.mktemp("passes") / "cell", "v_groove", "mild_steel")
    shutil.copy(EXAMPLE / "recording.toml", setup)
    text = path.read_text().replace("[jobs.1]\n", '[jobs.1]\nkeep_seam = "root.json"\n', 1)
    path.write_text(text + PASSES)
    (path.parent / "schedule.csv").write_text("gap_mm,speed_mm_s,weave_mm\n0.5,4,1\n2.5,2,3\n")
    replayed(path, 1)
    return path


def replayed(cell: Path, number: int) -> Replay:
    options = ReplayOptions(pictures=False, cell=read_cell_file(cell), job_number=number)
    return replay_recording(read_recording(EXAMPLE), cell.parent / f"results_{number}", options)


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def test_a_pass_without_the_laser_is_the_first_one_displaced(cell: Path) -> None:
    replay = replayed(cell, 2)
    first, second = (
        {int(row["frame"]): row for row in rows_of(cell.parent / f"results_{n}" / "results.csv")}
        for n in (1, 2)
    )
    sent = [n for n, row in second.items() if row["validity"] == "valid" and row["gate_reason"] == ""]
    assert len(sent) > 5
    for n in sent:
        moved_y_mm = float(second[n]["offset_y_mm"]) - float(first[n]["offset_y_mm"])
        moved_z_mm = float(second[n]["offset_z_mm"]) - float(first[n]["offset_z_mm"])
        # The first pass has not seen yet what lies beyond, and both run back from what they know.
        assert moved_y_mm == pytest.approx(1.75, abs=0.4)
        assert moved_z_mm == pytest.approx(1.0, abs=0.1)
        assert "pass_followed" in second[n]["flags"]
    assert replay.summary.valid == 0
    verdict = verdict_on(replay.recording, replay.tracks, replay.summary)
    assert not verdict.nothing_tracked
    assert "follows an earlier one without the laser" in verdict.line
    speeds = [float(row["weld_speed_mm_s"]) for row in second.values() if row["weld_speed_mm_s"]]
    assert speeds
    assert np.ptp(speeds) < 0.1
    assert {row["weld_refusal"] for row in second.values()} <= {"", "gap_mm_unknown"}
    assert {row["weld_speed_mm_s"] for row in first.values()} == {""}


def program(cell: Path, number: int) -> list[dict[str, str]]:
    out = cell.parent / f"program_{number}.csv"
    done = CliRunner().invoke(app, ["cell", "program", str(cell), "--job", str(number), "--out", str(out)])
    assert done.exit_code == 0, done.output
    return rows_of(out)


def places_of(rows: list[dict[str, str]]) -> np.ndarray:
    return np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in rows])


def test_a_program_lies_beside_the_seam_that_was_kept(cell: Path) -> None:
    kept, rows = read_seam(cell.parent / "root.json"), program(cell, 2)
    np.testing.assert_allclose(
        places_of(rows) - kept.points_base_mm, np.tile((0.0, 1.75, 1.0), (len(rows), 1)), atol=0.05
    )
    assert all(3.4 < float(row["weld_speed_mm_s"]) < 3.6 for row in rows)
    assert {row["weld_wire_m_min"] for row in rows} == {""}


def test_a_program_that_goes_back_turns_the_tool_round(cell: Path) -> None:
    kept, rows = read_seam(cell.parent / "root.json"), program(cell, 3)
    # To its own left, from its own end.
    np.testing.assert_allclose(
        places_of(rows) - kept.points_base_mm[::-1], np.tile((0.0, -2.0, 0.0), (len(rows), 1)), atol=0.05
    )
    tools = Rotation.from_quat([[float(row[name]) for name in ("qx", "qy", "qz", "qw")] for row in rows])
    x_base, z_base = tools.apply((1.0, 0.0, 0.0)), tools.apply((0.0, 0.0, 1.0))
    assert (x_base[:, 0] < -0.9).all()
    # It leans to the right of its travel, which is base's +y.
    before = Rotation.from_quat(kept.quaternions_xyzw[::-1]).apply((0.0, 0.0, 1.0))
    leans_deg = np.degrees(np.arctan2(z_base[:, 1], z_base[:, 2]) - np.arctan2(before[:, 1], before[:, 2]))
    np.testing.assert_allclose(leans_deg, 10.0, atol=0.1)


@pytest.mark.parametrize(("number", "words"), [(1, "[jobs.1.again]: missing"), (4, "--job 4")])
def test_a_job_without_an_earlier_pass_has_no_program(cell: Path, number: int, words: str) -> None:
    out = cell.parent / "none.csv"
    done = CliRunner().invoke(app, ["cell", "program", str(cell), "--job", str(number), "--out", str(out)])
    assert words in str(done.exception)
    assert not out.exists()


@pytest.mark.parametrize("name", ["cell.toml", "setup.toml", "root.json", "schedule.csv"])
def test_a_program_takes_no_place_of_a_file_of_the_cell(cell: Path, name: str) -> None:
    out = cell.parent / name
    before = out.read_bytes()
    done = CliRunner().invoke(app, ["cell", "program", str(cell), "--job", "2", "--out", str(out)])
    assert "is of the cell itself" in str(done.exception)
    assert out.read_bytes() == before


def test_a_black_box_has_the_pass_s_own_setup(cell: Path) -> None:
    read = read_cell_file(cell)
    for number in (2, 3):
        stated = parse_setup(job_setup_text(read, number), cell)
        job = read.jobs[number]
        assert stated.correction == job.correction
        assert stated.setup.joint == job.setup_for(read.setup.setup).joint


def test_a_check_of_the_cell_says_what_passes_do(cell: Path) -> None:
    done = CliRunner().invoke(app, ["cell", "check", str(cell)])
    assert "keeps" in done.output
    assert "root.json without the laser" in done.output.replace("\n", " ")
    assert "back along" in done.output


def test_a_replay_is_made_of_the_seam_that_it_follows(cell: Path) -> None:
    recording, read = read_recording(EXAMPLE), read_cell_file(cell)
    options = ReplayOptions(pictures=False, cell=read, job_number=2)
    before = made_of(recording, options)
    assert made_of(recording, options) == before
    seam = cell.parent / "root.json"
    seam.write_text(seam.read_text() + "\n")
    assert made_of(recording, options) != before
