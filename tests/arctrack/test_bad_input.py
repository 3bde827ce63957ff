"""What cannot be read or written is one line on stderr and exit code 2; what is whole stays whole."""

import os
import shutil
from pathlib import Path

import pytest
from spoiled import Refusal

from arctrack import cli


def cut_png(path: Path) -> None:
    png = path / "frames" / "000002.png"
    png.write_bytes(png.read_bytes()[:-30])


def test_a_disk_that_is_full(
    recording: Path, tmp_path: Path, refusal: Refusal, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", str(tmp_path / "results.csv"))

    monkeypatch.setattr("arctrack.recording.results.ResultsWriter.write", full)
    error = refusal("replay", recording, "--out", tmp_path)
    assert error == f"{tmp_path}/results.csv: No space left on device"


@pytest.mark.slow
def test_a_full_disk_of_one_log_stops_neither_its_replay_nor_the_others(
    recording: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    full, other = Path(shutil.copytree(recording, tmp_path / "full")), tmp_path / "other"
    shutil.copytree(recording, other)
    (full / "results").mkdir()
    (full / "results" / "bus.blf").symlink_to("/dev/full")
    monkeypatch.setattr("sys.argv", ["arctrack", "replay", str(full), str(other), "--no-pictures"])
    with pytest.raises(SystemExit) as exited:
        cli.main()
    said = " ".join(capsys.readouterr().err.split())
    # That these frames show no seam is another matter.
    assert exited.value.code == 3
    assert f"{full}/results/bus.blf: cannot be written: No space left on device" in caplog.text
    assert f"arctrack: warning: {full}: " in said
    assert "unlogged" in said
    for path in (full, other):
        assert (path / "results" / "summary.json").exists()


def test_what_the_system_refuses_of_one_recording_does_not_stop_the_others(
    recording: Path, tmp_path: Path, refusal: Refusal
) -> None:
    good = Path(shutil.copytree(recording, tmp_path / "good"))
    too_long = tmp_path / (300 * "x")
    assert refusal("replay", too_long, good, "--no-pictures").startswith(f"{too_long}: ")
    assert (good / "results" / "summary.json").exists()


@pytest.mark.slow
def test_rows_of_a_recording_with_a_bad_frame_are_all_there(
    recording: Path, tmp_path: Path, refusal: Refusal
) -> None:
    path = Path(shutil.copytree(recording, tmp_path / "r"))
    cut_png(path)
    error = refusal("replay", path, recording, "--out", tmp_path)
    assert "its results would replace others" in error
    refusal("replay", path, "--out", tmp_path / "out")
    rows = (tmp_path / "out" / "results.csv").read_text().splitlines()
    assert len(rows) == 5
    assert "frame_unreadable" in rows[3]
    assert (tmp_path / "out" / "summary.json").exists()
    assert (tmp_path / "out" / "overview.png").exists()


@pytest.mark.parametrize(
    ("command", "frame"), [(["inspect"], []), (["explain"], ["2"]), (["calibrate", "hand-eye"], [])]
)
@pytest.mark.parametrize(
    "name", ["recording.toml", "frames.csv", "poses.csv", "truth.csv", "can.blf", "frames/000001.png"]
)
def test_nothing_replaces_the_recording_that_is_read(
    command: list[str],
    frame: list[str],
    name: str,
    recording: Path,
    tmp_path: Path,
    refusal: Refusal,
) -> None:
    path = Path(shutil.copytree(recording, tmp_path / "r"))
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    out = tmp_path / "r" / ".." / "r" / name
    error = refusal(*command, path, *frame, "--out", out)
    assert error.startswith(f"{out}: is ")
    assert "itself; give --out another file" in error
    assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before


@pytest.mark.parametrize(("command", "frame"), [("inspect", []), ("explain", ["2"])])
def test_a_folder_is_no_file_to_write(
    command: str,
    frame: list[str],
    recording: Path,
    refusal: Refusal,
) -> None:
    error = refusal(command, recording, *frame, "--out", "/")
    assert error == "/: is a folder; give --out a file's name"


@pytest.mark.parametrize(("command", "frame"), [("replay", []), ("explain", ["2"]), ("diagnose", [])])
def test_a_folder_is_no_setup(
    command: str,
    frame: list[str],
    recording: Path,
    refusal: Refusal,
) -> None:
    error = refusal(command, recording, *frame, "--setup", recording)
    assert error == f"{recording}: is a folder; give the recording.toml in it"


@pytest.mark.parametrize(("command", "frame"), [("inspect", []), ("explain", ["2"])])
def test_a_fifo_is_no_file_to_write(
    command: str, frame: list[str], recording: Path, tmp_path: Path, refusal: Refusal
) -> None:
    os.mkfifo(tmp_path / "fifo")
    error = refusal(command, recording, *frame, "--out", tmp_path / "fifo")
    assert error == f"{tmp_path / 'fifo'}: is a FIFO; give --out a file's name"


def test_a_file_in_place_of_the_results(recording: Path, tmp_path: Path, refusal: Refusal) -> None:
    path = Path(shutil.copytree(recording, tmp_path / "r"))
    (path / "results").write_bytes(b"")
    error = refusal("inspect", path)
    assert error == f"{path / 'results'}: cannot be written: File exists; choose another with --out"
