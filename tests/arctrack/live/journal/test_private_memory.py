"""Memory that processes share is one user's alone: what another user puts in its place is never read."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from arctrack.live.cameras.camera_line import CameraLine, line_path, read_line
from arctrack.live.cameras.shared_frames import SharedFramesError, SharedFramesReader, SharedFramesWriter
from arctrack.live.journal import private_memory
from arctrack.live.journal.journal import JournalReader, status_name
from arctrack.live.journal.private_memory import open_private, private_path
from arctrack.live.journal.records import pack, unpack
from arctrack.live.journal.ring import RingError, RingWriter

OTHER = 65534
"""The user nobody, who owns no process of a tracker."""

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")


@pytest.fixture(autouse=True)
def memory(monkeypatch):
    """A folder as /dev/shm is: all may create in it, and remove what is theirs."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o1777)
        monkeypatch.setattr(private_memory, "MEMORY", folder)
        yield folder


def as_other(action) -> None:
    """Do something as another user, in a process of its own."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            os.setgroups([])
            os.setgid(OTHER)
            os.setuid(OTHER)
            action()
            code = 0
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0


class Attack:
    """What marks a folder once it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


@needs_root
def test_a_folder_that_another_user_made_first_is_refused(memory):
    folder = memory / f"arctrack-{os.geteuid()}"

    def take_it() -> None:
        folder.mkdir(0o777)
        (folder / status_name("run")).write_bytes(pickle.dumps(Attack(memory / "run-as-root")))

    as_other(take_it)
    for use in (
        lambda: JournalReader("run"),
        lambda: SharedFramesReader("camera"),
        lambda: SharedFramesWriter("camera", 4, 4),
        lambda: CameraLine("camera"),
        lambda: read_line("camera"),
    ):
        with pytest.raises(PermissionError, match="not this user's alone; have its owner or root"):
            use()
    assert not (memory / "run-as-root").exists()


@needs_root
def test_frames_of_another_user_are_nobodys(memory):
    def publish() -> None:
        SharedFramesWriter("camera", 4, 4)
        os._exit(0)

    as_other(publish)
    assert (memory / f"arctrack-{OTHER}").stat().st_mode & 0o777 == 0o700
    with pytest.raises(SharedFramesError, match="nobody publishes them"):
        SharedFramesReader("camera")


@needs_root
def test_nobody_else_may_look_in(memory):
    with SharedFramesWriter("camera", 4, 4) as frames:

        def look() -> None:
            with pytest.raises(PermissionError):
                frames.path.read_bytes()

        as_other(look)


def test_a_file_of_others_or_for_others_is_refused(memory):
    for mode in (0o644, 0o660, 0o601):
        path = private_path(f"frames-{mode:o}")
        path.write_bytes(b"")
        path.chmod(mode)
        with pytest.raises(PermissionError):
            SharedFramesReader(f"{mode:o}")
    if os.geteuid() == 0:
        path = private_path("frames-theirs")
        path.touch(0o600)
        os.chown(path, OTHER, OTHER)
        with pytest.raises(PermissionError):
            SharedFramesReader("theirs")


def test_no_link_is_followed_and_no_file_is_truncated(memory):
    kept = memory / "kept.toml"
    kept.write_text("what root wrote\n")
    kept.chmod(0o600)
    private_path("frames-camera").symlink_to(kept)
    line_path("camera").symlink_to(kept)
    with pytest.raises(PermissionError):
        SharedFramesReader("camera")
    with pytest.raises(PermissionError):
        SharedFramesWriter("camera", 4, 4)
    with pytest.raises(PermissionError):
        read_line("camera")
    # A tracker that takes the line puts its own in the link's place.
    line = CameraLine("camera")
    assert not line_path("camera").is_symlink()
    line.close()
    with pytest.raises(FileExistsError):
        open_private(line_path("camera"), os.O_RDWR | os.O_CREAT)
    assert kept.read_text() == "what root wrote\n"


def test_a_folder_that_is_a_link_is_refused(memory):
    (memory / "elsewhere").mkdir(0o700)
    (memory / f"arctrack-{os.geteuid()}").symlink_to(memory / "elsewhere")
    with pytest.raises(PermissionError):
        RingWriter("entries-1", 4, 64)


def test_a_pickle_is_no_record(memory):
    mark = memory / "ran"
    with pytest.raises(ValueError, match=r".*"):
        unpack(np.frombuffer(pickle.dumps(Attack(mark)), np.uint8))
    assert not mark.exists()
    with pytest.raises(ValueError, match="no record holds a Attack"):
        pack(Attack(mark))
    with pytest.raises(RingError, match="nobody"):
        JournalReader("run")
