"""Offline commands on a system without POSIX: all modules load, commands run, a live one says what lacks."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "v_groove"

# What Python's documentation names as of Unix alone; without os.uname, which NumPy asks for on Linux.
PRELUDE = """
import os, select, signal, socket, sys
MISSING = ("fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty")
for name in MISSING:
    sys.modules[name] = None
for module, names in {
    os: "chown fchmod fchown fork forkpty getegid geteuid getgid getgroups getloadavg getpgid getpgrp "
        "getpriority getresuid getuid killpg lchown mkfifo nice O_CLOEXEC O_DIRECTORY O_NOFOLLOW O_NONBLOCK "
        "pipe2 posix_fadvise posix_fallocate pread preadv pwrite pwritev readv sched_getaffinity "
        "sched_getparam sched_getscheduler sched_param sched_setaffinity sched_setscheduler sched_yield "
        "sendfile setpriority setsid setuid statvfs sync wait3 wait4 writev SCHED_FIFO memfd_create eventfd",
    select: "EPOLLIN epoll poll POLLIN",
    signal: "SIGALRM SIGCHLD SIGHUP SIGKILL SIGPIPE SIGQUIT SIGUSR1 SIGUSR2 setitimer sigwait",
    socket: "AF_UNIX SOCK_CLOEXEC SOCK_NONBLOCK socketpair",
}.items():
    for name in names.split():
        if hasattr(module, name):
            delattr(module, name)
"""

IMPORT_ALL = """
import importlib, pkgutil
for room in ("arctrack", "tracker", "noise_model", "calibration", "robot_io", "sim_to_real"):
    for module in pkgutil.walk_packages(importlib.import_module(room).__path__, room + "."):
        try:
            importlib.import_module(module.name)
        except Exception as error:
            # What an extra brings may be missing.
            if not isinstance(error, ModuleNotFoundError) or error.name in MISSING:
                print(module.name, error)
"""

RUN = """
import json, sys
sys.argv = ["arctrack", *json.loads(sys.stdin.read())]
from arctrack.cli import main
main()
"""


def without_posix(code: str, given: str = "") -> subprocess.CompletedProcess[str]:
    """Return what some code comes to in a process without the POSIX parts."""
    return subprocess.run(
        [sys.executable, "-c", PRELUDE + code], input=given, capture_output=True, text=True, check=False
    )


def command(*words: object) -> subprocess.CompletedProcess[str]:
    """Return what a command comes to there."""
    return without_posix(RUN, json.dumps([str(word) for word in words]))


def test_every_module_loads() -> None:
    loaded = without_posix(IMPORT_ALL)
    assert (loaded.returncode, loaded.stdout) == (0, ""), loaded.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("check", EXAMPLE),
        ("inspect", EXAMPLE),
        ("replay", EXAMPLE),
        ("plan", EXAMPLE),
        ("diagnose", EXAMPLE),
    ],
    ids=lambda words: words[0],
)
def test_an_offline_command_runs(words: tuple[object, ...], tmp_path: Path) -> None:
    out = ("--out", tmp_path / ("page.png" if words[0] in ("check", "inspect") else "out"))
    run = command(*words, *out)
    assert run.returncode == 0, run.stderr


@pytest.mark.slow
def test_a_setup_is_calibrated(tmp_path: Path) -> None:
    straight = tmp_path / "straight"
    size = ("--width", 320, "--height", 240)
    assert command("simulate", straight, "--seam-wander-mm", 0, *size).returncode == 0
    run = command("calibrate", "arc", straight, "--out", tmp_path / "arc.toml")
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "arc.toml").stat().st_size > 0


def test_several_at_once_are_refused() -> None:
    run = command("replay", EXAMPLE, "--workers", 2)
    assert run.returncode == 2
    assert "arctrack: error: --workers 2: this system takes one recording at a time" in run.stderr


@pytest.mark.parametrize("words", [("serve", "--simulated"), ("doctor",), ("cell", "serve")])
def test_a_live_command_says_what_the_system_lacks(words: tuple[str, ...]) -> None:
    run = command(*words)
    assert run.returncode == 2
    assert run.stderr.count("\n") == 1
    assert "needs Linux: this system lacks file locks, real-time priorities" in run.stderr


def test_kernels_are_kept_in_the_users_own_folder_alone(tmp_path: Path) -> None:
    where = """
import os
os.environ |= {"HOME": given, "XDG_CACHE_HOME": given + "/cache"}
os.environ.pop("NUMBA_CACHE_DIR", None)
from noise_model.compiled.store import kernel_folder
print(kernel_folder())
kernel_folder.cache_clear()
os.environ["HOME"] = given + "/another"
print(kernel_folder())
"""
    shown = without_posix(f"given = {str(tmp_path)!r}\n{where}")
    assert shown.stdout.split() == [str(tmp_path / "cache/arctrack/kernels"), "None"], shown.stderr
