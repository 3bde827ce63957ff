"""Recordings that an interrupted run finished are taken over; all others are replayed anew."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from arctrack.replay.replay import ReplayOptions
from arctrack.replays import ReplayResult, jobs_for, replay_job
from tests.arctrack.test_replays_at_once import copies, rows, run

OPTIONS = ReplayOptions(pictures=False)
DEADLINE_S = 300.0


def replayed(recording: Path, out: Path, options: ReplayOptions = OPTIONS) -> ReplayResult:
    (job,) = jobs_for([recording], out, None, options, resume=True)
    return replay_job(job)


@pytest.mark.slow
def test_a_killed_run_goes_on_with_what_is_not_finished(
    compiled: None, simulated: Path, tmp_path: Path
) -> None:
    recordings = copies(simulated, tmp_path, "a", "b", "c")
    out = tmp_path / "out"
    start = [sys.executable, "-c", "from arctrack.cli import main; main()", "replay", "--no-pictures"]
    killed = subprocess.Popen([*start, *map(str, recordings), "--out", str(out)], stdout=subprocess.DEVNULL)
    deadline_s = time.monotonic() + DEADLINE_S
    while not (out / "a" / "finished.json").exists():
        assert killed.poll() is None
        assert time.monotonic() < deadline_s
        time.sleep(0.01)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    done = [path.name for path in recordings if (out / path.name / "finished.json").exists()]
    # Had it come to its end before the signal, nothing would be left to do.
    (out / "c" / "finished.json").unlink(missing_ok=True)
    first = (out / "a" / "results.csv").stat().st_mtime_ns

    resumed = run(*recordings, "--out", out, "--resume")
    assert resumed.exit_code == 0, resumed.output
    lines = resumed.stdout.splitlines()
    taken_over = [line.split(":")[0] for line in lines if ": taken over: results in" in line]
    assert taken_over == [name for name in done if name != "c"]
    assert f"†: taken over from an earlier run, {len(taken_over)} of 3" in resumed.stdout
    assert (out / "a" / "results.csv").stat().st_mtime_ns == first

    through = run(*recordings, "--out", tmp_path / "through")
    for name in ("a", "b", "c"):
        assert rows(out / name) == rows(tmp_path / "through" / name)
    assert "taken over" not in through.stdout

    again = run(*recordings, "--out", out, "--resume", "--workers", "2")
    assert "†: taken over from an earlier run, 3 of 3" in again.stdout


def half(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def touch(path: Path) -> None:
    os.utime(path, ns=(1, 1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("out/finished.json", half),
        ("out/finished.json", lambda path: path.write_text("[]")),
        ("out/results.csv", half),
        ("out/summary.json", Path.unlink),
        ("a/recording.toml", lambda path: path.write_text(path.read_text() + "\n# another\n")),
        ("a/poses.csv", lambda path: path.write_text(path.read_text() + "\n")),
        ("a/frames/000003.png", touch),
    ],
)
def test_what_is_another_or_not_whole_is_replayed(
    compiled: None, simulated: Path, tmp_path: Path, name: str, spoil: Callable[[Path], object]
) -> None:
    (recording,) = copies(simulated, tmp_path, "a")
    first = replayed(recording, tmp_path / "out")
    spoil(tmp_path / name)
    again = replayed(recording, tmp_path / "out")
    assert not again.is_taken_over
    assert again.summaries[0].score == first.summaries[0].score
    assert replayed(recording, tmp_path / "out").is_taken_over


@pytest.mark.slow
def test_what_is_taken_over_says_what_the_run_said(compiled: None, simulated: Path, tmp_path: Path) -> None:
    (recording,) = copies(simulated, tmp_path, "a")
    (recording / "frames" / "000003.png").write_bytes(b"no PNG")
    first = replayed(recording, tmp_path / "out")
    taken = replayed(recording, tmp_path / "out")
    assert taken.is_taken_over
    assert json.dumps(taken.summaries[0].to_json()) == json.dumps(first.summaries[0].to_json())
    assert taken.verdict == first.verdict
    assert taken.complaint == first.complaint is not None
    assert (taken.warnings, taken.replay_warnings) == (first.warnings, first.replay_warnings)
    without = ReplayOptions(pictures=False, use_arc_map=False)
    assert not replayed(recording, tmp_path / "out", without).is_taken_over
