"""The folder that keeps a user's kernels: it never stops a run, and does not grow for ever."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from noise_model.compiled import store
from noise_model.compiled.store import Record, kernels_are_stored, read_records, write_record

RECORD = Record(("inner",), 1.5, b"machine code")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Yield the folder of all kernels, as a new process finds it."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(store, "_WARNED", set())
    forget()
    yield tmp_path / "arctrack" / "kernels"
    monkeypatch.undo()
    forget()


def forget() -> None:
    """Ask anew where kernels lie, as a new process does."""
    for known in (store.kernel_folder, store._folder_of, store._make_room):
        known.cache_clear()


def test_what_is_kept_comes_back() -> None:
    write_record("optics.inner", "0123-45", RECORD)
    assert list(read_records("optics.inner", "0123")) == [RECORD]
    assert list(read_records("optics.inner", "9")) == []
    assert kernels_are_stored()


def test_what_is_damaged_is_absent_and_said_in_one_line(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for key in ("0-1", "0-2", "0-3"):
        write_record("optics.inner", key, RECORD)
    kept = folder / "optics.inner"
    (kept / "0-1").write_bytes((kept / "0-1").read_bytes()[:-1])
    (kept / "0-2").write_bytes(b"")
    assert list(read_records("optics.inner", "0")) == [RECORD]
    assert len(caplog.messages) == 1
    assert "is damaged; what is damaged is compiled anew" in caplog.text


def test_a_folder_that_cannot_be_written_is_said_in_one_line(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder.parent.mkdir()
    folder.touch()
    for key in ("0-1", "0-2"):
        write_record("optics.inner", key, RECORD)
    assert not kernels_are_stored()
    assert list(read_records("optics.inner", "0")) == []
    assert caplog.messages == [
        "arctrack: warning: no folder keeps compiled kernels; "
        "set NUMBA_CACHE_DIR to one that only you may write"
    ]


def test_a_full_disk_is_said_in_one_line(
    monkeypatch: pytest.MonkeyPatch, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    for key in ("0-1", "0-2"):
        write_record("optics.inner", key, RECORD)
    assert not kernels_are_stored()
    assert [message.partition("(")[2] for message in caplog.messages] == [
        "No space left on device): the next run compiles anew"
    ]
    assert list((folder / "optics.inner").iterdir()) == [], "nothing half written stays"


def test_what_was_not_used_longest_goes_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for key in "012":
        write_record("optics.inner", key, RECORD)
    for key, used in (("0", 3e9), ("1", 1e9), ("2", 2e9)):
        os.utime(folder / "optics.inner" / key, (used, used))
    monkeypatch.setattr(store, "MAX_BYTES", 2 * (folder / "optics.inner" / "0").stat().st_size)
    forget()
    write_record("optics.outer", "0", RECORD)
    assert sorted(file.name for file in folder.glob("optics.inner/*")) == ["0", "2"]
    list(read_records("optics.inner", "2"))
    assert (folder / "optics.inner" / "2").stat().st_mtime != 2e9


def test_a_user_without_a_home_keeps_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    forget()
    assert store.kernel_folder() is None
