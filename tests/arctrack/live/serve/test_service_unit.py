"""The documented unit under a systemd of its own, in namespaces: it starts, goes on, restarts, ends."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from test_house import ROOT

PYTHON = "/usr/bin/python3"
NEEDED = ("ip", "nsenter", "systemctl", "unshare", "useradd")
BUS = "udp_multicast:239.74.163.77"

COMMAND = f"""#!{PYTHON} -s
import sys
sys.path[:0] = ["/opt/source", "/opt/packages"]
from arctrack.cli import main
main()
"""

ROBOT = f"""[Service]
User=arctrack
RuntimeDirectory=robot
StandardOutput=file:/run/robot.log
ExecStart=/opt/arctrack/.venv/bin/arctrack cell serve --bus {BUS} --frames unit --write-cell /run/robot/cell
"""

# /etc, /var and /opt take what is written in memory; the bus is a network that has its loopback alone.
BOOT = """
set -eu
mount --make-rprivate /
mount -t tmpfs tmpfs "$1"
for folder in etc var opt; do
  mkdir -p "$1/$folder/upper" "$1/$folder/work"
  mount -t overlay overlay -o "lowerdir=/$folder,upperdir=$1/$folder/upper,workdir=$1/$folder/work" "/$folder"
done
mount -t tmpfs tmpfs /run
mount -t tmpfs tmpfs /dev/shm
mount -t cgroup2 cgroup2 /sys/fs/cgroup
ip link set lo up
ip link set lo multicast on
ip route add 224.0.0.0/4 dev lo
useradd --system --groups video,dialout arctrack
mkdir -p /opt/source /opt/packages /opt/arctrack/.venv/bin /etc/arctrack /run/units
mount --bind "$2" /opt/source
mount --bind "$3" /opt/packages
printf '%s' "$4" > /opt/arctrack/.venv/bin/arctrack
chmod 755 /opt/arctrack/.venv/bin/arctrack
printf '%s' "$5" > /run/units/robot.service
cp /opt/source/docs/how_to/arctrack.service /run/units
for target in basic multi-user network shutdown sysinit; do
  printf '[Unit]\\nDefaultDependencies=no\\n' > "/run/units/$target.target"
done
mkdir /run/units/arctrack.service.d
printf '[Service]\\nStandardOutput=append:/run/log\\nStandardError=append:/run/log\\n' \\
  > /run/units/arctrack.service.d/log.conf
exec env -i container=test PATH="$PATH" SYSTEMD_UNIT_PATH=/run/units \\
  /lib/systemd/systemd --system --unit=basic.target --show-status=no
"""


def missing() -> list[str]:
    """Return what this machine lacks for a systemd of the test's own."""
    lacking = [name for name in NEEDED if shutil.which(name) is None]
    if os.geteuid() != 0:
        lacking.append("root")
    if not Path("/lib/systemd/systemd").exists():
        lacking.append("systemd")
    version = "import sys; print(*sys.version_info[:2])"
    if not Path(PYTHON).exists() or subprocess.run(
        [PYTHON, "-c", version], capture_output=True, text=True, check=True
    ).stdout.split() != [str(n) for n in sys.version_info[:2]]:
        lacking.append("Debian's Python of this version")
    return lacking


class NamespacedMachine:
    """A systemd and what it runs, apart from this machine's files, processes and network."""

    def __init__(self, folder: Path) -> None:
        words = [folder, ROOT, sysconfig.get_path("purelib"), COMMAND, ROBOT]
        namespaces = ["--mount", "--pid", "--uts", "--ipc", "--net", "--cgroup"]
        self._process = subprocess.Popen(
            [
                "unshare",
                "--fork",
                "--kill-child",
                "--mount-proc",
                *namespaces,
                "bash",
                "-c",
                BOOT,
                "boot",
                *map(str, words),
            ],
            stdin=subprocess.DEVNULL,
        )
        parent = self._process.pid
        children = Path(f"/proc/{parent}/task/{parent}/children")
        self._inside = ["nsenter", *namespaces]
        # unshare's one child becomes the systemd.
        self.wait_for(lambda: bool(children.read_text()), 10.0)
        self._inside += ["--target", children.read_text().strip()]
        self.wait_for(lambda: self.run("systemctl", "is-active", "basic.target") == "active", 20.0)

    def run(self, *words: str) -> str:
        """Return what a command prints in there."""
        done = subprocess.run([*self._inside, *words], capture_output=True, text=True, check=False)
        return done.stdout.strip()

    def shown(self, name: str) -> str:
        """Return a property of the unit."""
        return self.run("systemctl", "show", "--value", "--property", name, "arctrack.service")

    def wait_for(self, is_so: Callable[[], bool], limit_s: float) -> None:
        """Wait until something is so."""
        ends_s = time.monotonic() + limit_s
        while not is_so():
            assert self._process.poll() is None, "the namespaces could not be made"
            assert time.monotonic() < ends_s, self.run("cat", "/run/log")
            time.sleep(0.1)

    def wait_ready(self, restarts: int) -> None:
        """Wait until the unit has been restarted so often and is ready."""
        self.wait_for(
            lambda: (self.shown("NRestarts"), self.shown("ActiveState")) == (str(restarts), "active"), 240.0
        )

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait(10.0)


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[NamespacedMachine]:
    booted = NamespacedMachine(tmp_path)
    try:
        yield booted
    finally:
        booted.close()


@pytest.mark.slow
@pytest.mark.skipif(bool(missing()), reason=f"lacks {', '.join(missing())}")
def test_the_unit_is_ready_goes_on_is_restarted_and_ends(machine: NamespacedMachine) -> None:
    machine.run("systemctl", "start", "robot.service")
    machine.wait_for(lambda: "Ctrl-C ends it" in machine.run("cat", "/run/robot.log"), 60.0)
    machine.run("sh", "-c", "cp -r /run/robot/cell/. /etc/arctrack")
    box = r's|^\[black_box\]|&\nfolder = "/var/lib/arctrack/black_box"|'
    machine.run("sed", "-i", box, "/etc/arctrack/cell.toml")
    machine.run("systemctl", "start", "arctrack.service")
    machine.wait_ready(0)
    assert machine.shown("StatusText").startswith("ready: shared_memory unit")
    main = machine.shown("MainPID")
    assert machine.run("ps", "-o", "user=", "-p", main) == "arctrack"
    # Longer than WatchdogSec: a loop that did not feed it would be ended.
    time.sleep(7.0)
    assert (machine.shown("NRestarts"), machine.shown("MainPID")) == ("0", main)
    machine.run("kill", "-KILL", main)
    machine.wait_ready(1)
    assert machine.shown("MainPID") not in ("0", main)
    machine.run("systemctl", "stop", "arctrack.service")
    assert (machine.shown("ActiveState"), machine.shown("Result")) == ("inactive", "success")
    assert "offsets: " in machine.run("cat", "/run/log")
    assert machine.run("stat", "--format", "%U", "/var/lib/arctrack", "/var/cache/arctrack").split() == [
        "arctrack",
        "arctrack",
    ]
