"""Commands of the documentation, run where a reader runs them: in a folder that looks like the repository.

Several tests need what the same command makes of the same inputs. It is run once in a run of pytest.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from once import once

from arctrack.nominal import DIMENSIONS, nominal_setup
from noise_model.condition import Condition
from noise_model.forward import predict
from tracker.tracker import Tracker

ROOT = Path(__file__).resolve().parents[1]


def compile_kernels(_: Path) -> None:
    """Compile what tracks and draws each joint: a command that runs after this finds it on disk."""
    for joint in DIMENSIONS:
        setup = nominal_setup(joint, "mild_steel", width=160, height=120)
        Tracker(setup).warm_up()
        predict(setup, np.eye(4), Condition(1.0, 1.0, setup.camera.exposure_s))


def make_scratch(folder: Path) -> None:
    """Make a folder look to a command like the repository, with /tmp of its own."""
    shutil.copytree(
        ROOT / "examples", folder / "clone" / "examples", ignore=shutil.ignore_patterns("results")
    )
    for name in ("docs", "benchmarks"):
        (folder / "clone" / name).symlink_to(ROOT / name)
    (folder / "tmp").mkdir()


def run(command: list[str], scratch: Path) -> str:
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        command,
        cwd=scratch / "clone",
        env={**os.environ, "PATH": path, "COLUMNS": "120", "NO_COLOR": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{command[-1]}\n{done.stdout}"
    return done.stdout


def digest(text: str, scratch: Path) -> str:
    """Return a digest of a command and of all that the files and folders hold that it names."""
    parts = hashlib.sha256(text.encode())
    for word in shlex.split(text):
        named = scratch / word[1:] if word.startswith("/tmp/") else scratch / "clone" / word
        for path in [named, *sorted(named.rglob("*"))]:
            if path.is_file():
                parts.update(f"\n{path.relative_to(scratch)} {path.stat().st_size}\n".encode())
                parts.update(path.read_bytes())
    return parts.hexdigest()[:16]


def written(scratch: Path) -> dict[Path, int]:
    """Return the files below a folder, with the time at which they were written, ns."""
    return {path: path.stat().st_mtime_ns for path in scratch.rglob("*") if path.is_file()}


def run_shown(text: str, scratch: Path) -> str:
    """Run a command with /tmp of its own, and return its output as if /tmp were the reader's."""
    program = text.replace("/tmp/", f"{scratch / 'tmp'}/")
    words = shlex.split(program)
    if words[0] == "arctrack" and "||" not in words:
        return run_forked(words, scratch).replace(f"{scratch}/", "/")
    return run(["bash", "-euo", "pipefail", "-c", program], scratch).replace(f"{scratch}/", "/")


FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(
    [
        "arctrack.replay.explain",
        "arctrack.check.survey",
        "arctrack.replay.pages.page",
        "arctrack.simulation.simulate",
    ]
)


def run_forked(words: list[str], scratch: Path) -> str:
    """Run a command of arctrack in a process forked from one that has imported most of it, and no more."""
    said = scratch / "said"
    process = FORKS.Process(target=_command, args=(words, scratch / "clone", dict(os.environ), said))
    process.start()
    process.join()
    output = said.read_text()
    said.unlink()
    assert process.exitcode == 0, f"{words}\n{output}"
    return output


def _command(words: list[str], folder: Path, environment: dict[str, str], said: Path) -> None:
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment, COLUMNS="120", NO_COLOR="1")
    with said.open("w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    sys.argv = words
    # Imported here: what it says of colours and columns is that environment's.
    from arctrack.cli import main

    main()


def run_once(text: str, scratch: Path, shared: Path) -> str:
    """Run a command, or take output and files of an equal one with equal inputs that another test has run."""

    def make(folder: Path) -> None:
        before = written(scratch)
        (folder / "output").write_text(run_shown(text, scratch))
        for path, time_ns in written(scratch).items():
            if before.get(path) != time_ns:
                copy = folder / "files" / path.relative_to(scratch)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(path, copy)

    ran = once(shared, f"command_{digest(text, scratch)}", make)
    if (ran / "files").exists():
        shutil.copytree(ran / "files", scratch, dirs_exist_ok=True)
    return (ran / "output").read_text()
