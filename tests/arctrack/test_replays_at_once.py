"""Several recordings replayed by one command: in processes, on a cluster."""

import csv
import re
import shutil
from pathlib import Path

import pytest
from click.testing import Result
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.errors import ArctrackError

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})


def run(*arguments: Path | str) -> Result:
    return RUNNER.invoke(app, ["replay", *map(str, arguments), "--no-pictures"])


def rows(folder: Path) -> list[dict[str, str]]:
    """Return results.csv without what is measured by a clock."""
    with (folder / "results.csv").open(newline="", encoding="utf-8") as file:
        return [{key: row[key] for key in row if key != "compute_ms"} for row in csv.DictReader(file)]


def copies(recording: Path, folder: Path, *names: str) -> list[Path]:
    return [Path(shutil.copytree(recording, folder / name)) for name in names]


@pytest.mark.slow
def test_processes_write_what_a_replay_in_turn_writes(
    compiled: None, simulated: Path, tmp_path: Path
) -> None:
    first, broken, last = copies(simulated, tmp_path, "a", "b", "c")
    (broken / "poses.csv").unlink()
    at_once = run(last, broken, first, "--workers", "2", "--out", tmp_path / "at_once")
    in_turn = run(last, broken, first, "--out", tmp_path / "in_turn")
    assert at_once.exit_code == in_turn.exit_code == 2
    for result in (at_once, in_turn):
        assert [line for line in result.stderr.splitlines() if "error" in line] == [
            f"arctrack: error: {broken}/poses.csv: there are no poses: neither this file nor can.asc, "
            "can.blf, can.csv, can.db, can.log, can.trc exists"
        ]
    kept = [
        [line for line in result.stdout.splitlines() if re.match(r"[ac]: \d+ of \d+ offsets sent", line)]
        for result in (at_once, in_turn)
    ]
    assert kept[0] == kept[1]
    assert [line[0] for line in kept[0]] == ["c", "a"]
    for name in ("a", "c"):
        tracked = rows(tmp_path / "at_once" / name)
        assert len(tracked) == 14
        assert tracked == rows(tmp_path / "in_turn" / name)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_dask_cluster_replays(simulated: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    with distributed.LocalCluster(n_workers=1, processes=False, dashboard_address=None) as here:
        result = run(simulated, "--scheduler", here.scheduler_address, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert len(rows(tmp_path / "out")) == 14


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (
            ["--workers", "2", "--scheduler", "tcp://127.0.0.1:1"],
            "--workers and --scheduler: take one of them",
        ),
        (
            ["--workers", "2", "--bus", "udp_multicast:239.74.163.2", "--onto-a-robot"],
            "--bus udp_multicast:239.74.163.2: a robot follows one replay at a time; leave --workers and "
            "--scheduler out",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(
    recording: Path, tmp_path: Path, options: list[str], problem: str
) -> None:
    result = run(*copies(recording, tmp_path, "a", "b"), *options)
    assert isinstance(result.exception, ArctrackError)
    assert str(result.exception) == problem
    assert not (tmp_path / "a" / "results").exists()


def test_several_recordings_keep_no_seam_in_one_file(recording: Path, tmp_path: Path) -> None:
    cell = tmp_path / "cell.toml"
    cell.write_text(
        f'format = "arctrack-cell/1"\nsetup = "{recording / "recording.toml"}"\n'
        '[bus]\ninterface = "virtual"\nchannel = "c"\n[camera]\nframe_rate_hz = 25.0\n'
        '[jobs.1]\nname = "root"\nkeep_seam = "root.json"\n'
    )
    result = run(*copies(recording, tmp_path, "a", "b"), "--cell", cell)
    assert isinstance(result.exception, ArctrackError)
    assert str(result.exception) == (
        f"{cell}: [jobs.1] keep_seam: keeps one recording's seam; replay one at a time"
    )
    assert not (tmp_path / "a" / "results").exists()
