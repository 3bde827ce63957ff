"""Many recordings in one view: its page, its table, a cluster whose worker dies, diagnoses taken over."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest
from bs4 import BeautifulSoup

from arctrack.errors import ArctrackError
from arctrack.fleet import FleetRow, FleetState, followed
from tests.arctrack import test_diagnose_command
from tests.arctrack.test_diagnose_command import Found
from tests.arctrack.test_diagnose_command import run as diagnose
from tests.arctrack.test_replays_at_once import copies
from tests.arctrack.test_replays_at_once import run as replay

DEADLINE_S = 300.0

found = test_diagnose_command.found


def table_of(folder: Path) -> list[dict[str, object]]:
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra 'parquet' is not installed")
    rows: list[dict[str, object]] = parquet.read_table(folder / "fleet.parquet").to_pylist()
    return rows


def page_of(folder: Path) -> BeautifulSoup:
    return BeautifulSoup((folder / "fleet.html").read_text(encoding="utf-8"), "html.parser")


def words(page: BeautifulSoup, selector: str) -> list[str]:
    return [each.get_text() for each in page.select(selector)]


def test_the_page_follows_the_work_and_shows_first_what_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("arctrack.fleet.REFRESH_S", 0)
    folder = tmp_path / "fleet"
    rows = [
        FleetRow(
            tmp_path / "good", tmp_path / "out", FleetState.DONE, "12 sent", {"valid": 12}, "a.html", 1.0
        ),
        FleetRow(tmp_path / "few", tmp_path / "out", FleetState.DONE, "2 sent", {"valid": 2}, "a.html", 0.2),
        FleetRow(tmp_path / "<bad>", tmp_path / "out", FleetState.FAILED, "no poses"),
    ]
    with followed(folder, "replay", 4, {"valid": "int64", "y_rms_mm": "float64"}) as on_row:
        assert words(page_of(folder), "h1") == ["0 of 4 recordings"]
        for row in rows:
            on_row(row)
        page = page_of(folder)
        assert page.select("meta[http-equiv=refresh]")
        assert words(page, "h1") == ["3 of 4 recordings: 1 failed"]
        assert "Under way" in words(page, ".verdict p")[0]
        assert not (folder / "fleet.parquet").exists()
    page = page_of(folder)
    assert not page.select("meta[http-equiv=refresh]")
    assert words(page, "tr > td:first-child") == ["<bad>", "few", "good"]
    assert page.select("td a")[0]["href"].endswith("/out/a.html")
    told = table_of(folder)
    assert [row["valid"] for row in told] == [12, 2, None]
    assert [row["state"] for row in told] == ["done", "done", "failed"]
    assert {row["y_rms_mm"] for row in told} == {None}


def test_an_interrupted_run_leaves_what_was_done(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="the extra 'parquet' is not installed")

    def interrupted() -> None:
        with followed(tmp_path / "f", "replay", 2, {}) as on_row:
            on_row(FleetRow(tmp_path / "a", tmp_path / "out", FleetState.DONE))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(table_of(tmp_path / "f")) == 1


def test_what_cannot_be_written_is_said_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(ArctrackError, match="is a file; --fleet takes a folder"),
        followed(tmp_path / "file", "replay", 1, {}),
    ):
        pass
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with (
        pytest.raises(ArctrackError, match=r"--fleet: needs the package pyarrow"),
        followed(tmp_path / "f", "replay", 1, {}),
    ):
        pass
    assert not (tmp_path / "f").exists()


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_cluster_whose_worker_is_killed_loses_nothing(
    compiled: None, simulated: Path, tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    recordings = copies(simulated, tmp_path, *"abcdefgh")
    (recordings[3] / "poses.csv").unlink()
    out, fleet, killed = tmp_path / "out", tmp_path / "fleet", []

    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as here:

        def kill() -> None:
            until_s = time.monotonic() + DEADLINE_S
            while not list(out.glob("*/results.csv")) and time.monotonic() < until_s:
                time.sleep(0.01)
            pid = next(iter(here.workers.values())).pid
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)

        killer = threading.Thread(target=kill)
        killer.start()
        result = replay(*recordings, "--scheduler", here.scheduler_address, "--out", out, "--fleet", fleet)
        killer.join()
    assert killed
    assert result.exit_code == 2, result.output
    told = {row["recording"]: row for row in table_of(fleet)}
    assert sorted(told) == list("abcdefgh")
    assert told.pop("d")["state"] == "failed"
    assert {(row["state"], row["frames"]) for row in told.values()} == {("done", 14)}

    again = replay(*recordings, "--out", out, "--fleet", fleet, "--resume")
    assert again.exit_code == 2
    assert sorted(row["state"] for row in table_of(fleet)) == ["failed", *["taken over"] * 7]


def test_a_finished_diagnosis_is_taken_over(found: Found, simulated: Path, tmp_path: Path) -> None:
    recordings = copies(simulated, tmp_path, "a", "b")
    first = diagnose(*recordings, "--fleet", tmp_path / "first")
    assert first.exit_code == 0, first.output
    (tmp_path / "b" / "diagnosis" / "report.html").unlink()
    again = diagnose(*recordings, "--resume", "--fleet", tmp_path / "again")
    assert again.exit_code == 0, again.output
    assert "†: taken over from an earlier run, 1 of 2" in again.stdout
    before, after = table_of(tmp_path / "first"), table_of(tmp_path / "again")
    assert [row["state"] for row in after] == ["taken over", "done"]
    assert {row["verdict"] for row in before} == {"effects"}
    assert {row["effects"] for row in after} == {"gamma"}
    for one, other in zip(before, after, strict=True):
        assert {**one, "state": ""} == {**other, "state": ""}
    # Other effects to seek are another diagnosis.
    other = diagnose(*recordings, "--resume", "--without", "fume", "--fleet", tmp_path / "other")
    assert other.exit_code == 0, other.output
    assert [row["state"] for row in table_of(tmp_path / "other")] == ["done", "done"]


def test_a_diagnosis_that_is_taken_over_cannot_be_applied(
    found: Found, simulated: Path, tmp_path: Path
) -> None:
    (recording,) = copies(simulated, tmp_path, "a")
    result = diagnose(recording, "--resume", "--apply")
    assert isinstance(result.exception, ArctrackError)
    assert str(result.exception) == "--resume takes over reports alone: leave it out with --apply and --on"
