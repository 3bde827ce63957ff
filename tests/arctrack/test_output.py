from pathlib import Path

import pytest

from arctrack.errors import ArctrackError
from arctrack.output import make_folder, write_whole
from arctrack.recording import read_recording
from arctrack.recording.results import ResultsWriter
from arctrack.replay.replay import ReplayOptions, replay_recording


def test_an_earlier_runs_files_are_gone(tmp_path: Path) -> None:
    folder = tmp_path / "made" / "anew"
    make_folder(folder, ["a", "b"])
    for name in ("a", "b", "notes.txt"):
        (folder / name).write_text("old")
    make_folder(folder, ["a", "b"])
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]
    with pytest.raises(ArctrackError, match=r"notes.txt: cannot be written: .*choose another with --out"):
        make_folder(folder / "notes.txt", [])


def test_what_a_link_points_at_is_replaced_and_keeps_its_permissions(tmp_path: Path) -> None:
    file, link = tmp_path / "file", tmp_path / "link"
    file.write_text("old")
    file.chmod(0o640)
    link.symlink_to(file)
    write_whole(link, "new")
    assert link.is_symlink()
    assert file.read_text() == "new"
    assert file.stat().st_mode & 0o777 == 0o640
    assert {path.name for path in tmp_path.iterdir()} == {"file", "link"}


def test_a_new_file_has_the_permissions_of_any(tmp_path: Path) -> None:
    write_whole(tmp_path / "new", "text")
    (tmp_path / "other").write_text("text")
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_a_file_that_cannot_be_written_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device")

    file = tmp_path / "file"
    file.write_text("old")
    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(ArctrackError, match="file: cannot be written: No space left on device"):
        write_whole(file, "new")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert file.read_text() == "old"


def test_a_full_disk_names_the_file(tmp_path: Path) -> None:
    (tmp_path / "results.csv").symlink_to("/dev/full")
    with pytest.raises(ArctrackError, match=r"results.csv: cannot be written: No space left on device"):
        ResultsWriter(tmp_path)


def test_a_summary_is_written_whole_or_not_at_all(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(ArctrackError, match=r"summary.json: cannot be written: No space left on device"):
        replay_recording(read_recording(simulated), tmp_path, ReplayOptions(pictures=False))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bus.blf", "results.csv"]
