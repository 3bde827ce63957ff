"""A disk, or shared memory, that is full: the error names the path that could not be written."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from arctrack.errors import ArctrackError
from arctrack.nominal import nominal_setup
from arctrack.recording.writer import RecordingWriter, VideoFormat
from tracker.state import Frame

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        os.geteuid() != 0 or shutil.which("unshare") is None, reason="needs root: it mounts small disks"
    ),
]

EXAMPLE = str(Path(__file__).parents[2] / "examples" / "v_groove")
MAIN = "from arctrack.cli import main; main()"


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """Yield a folder on a disk of 64 kB that has no room left."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", disk]).returncode != 0:
        pytest.skip("nothing can be mounted here")
    try:
        (disk / "filling").write_bytes(bytes(65536))
        yield disk
    finally:
        subprocess.run(["umount", disk], check=True)


@pytest.mark.parametrize(
    ("words", "file"),
    [
        (["new", "{out}"], "recording.toml"),
        (["cell", "new", "{out}"], "setup.toml"),
        (["simulate", "{out}"], "recording.toml"),
        (["inspect", EXAMPLE, "--out", "{out}.png"], ".png"),
        (["check", EXAMPLE, "--out", "{out}.png"], ".png"),
        (["explain", EXAMPLE, "12", "--out", "{out}.html"], ".html"),
        (["replay", EXAMPLE, "--no-pictures", "--out", "{out}"], "results.csv"),
    ],
)
def test_a_command_names_what_it_could_not_write(full_disk: Path, words: list[str], file: str) -> None:
    out = full_disk / "made"
    command = [sys.executable, "-c", MAIN, *(word.format(out=out) for word in words)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    said = done.stderr.splitlines()[-1]
    assert said.startswith(f"arctrack: error: {out}")
    assert said.endswith(f"{file}: cannot be written: No space left on device")


@pytest.mark.parametrize("video", [None, VideoFormat(25.0)])
def test_a_recording_that_fills_the_disk_names_its_file(full_disk: Path, video: VideoFormat | None) -> None:
    setup = nominal_setup("lap", "mild_steel")
    (full_disk / "filling").write_bytes(bytes(16384))
    shape = (setup.camera.height, setup.camera.width)
    noise = np.random.default_rng(1).integers(0, 255, shape).astype(setup.sensor.dtype)
    made = RecordingWriter(full_disk / "made", setup, video=video)

    def write() -> None:
        with made:
            for n in range(100):
                made.write_frame(Frame(n, 0.04 * n, noise, 0.001))

    with pytest.raises(ArctrackError) as caught:
        write()
    said = str(caught.value)
    assert said.startswith(f"{made.unfinished_path}/frames")
    assert said.endswith(": cannot be written: No space left on device")


@pytest.mark.usefixtures("multicast")
@pytest.mark.parametrize("size", ["64k", "4m"])
def test_shared_memory_that_is_too_small_is_named(size: str, tmp_path: Path) -> None:
    if subprocess.run(["unshare", "-m", "true"], check=False).returncode != 0:
        pytest.skip("a container without the right to mount")
    mount = f"mount -t tmpfs -o size={size} tmpfs /dev/shm"
    serve = f"{mount} && exec {sys.executable} -c '{MAIN}' serve --simulated"
    done = subprocess.run(["unshare", "-m", "sh", "-c", serve], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    # Getting ready may take so long that it says so.
    line = done.stderr.splitlines()[-1]
    assert "/dev/shm/arctrack-0/" in line
    assert "MB: No space left on device; mount -o remount,size=… /dev/shm, or docker run --shm-size=…" in line
