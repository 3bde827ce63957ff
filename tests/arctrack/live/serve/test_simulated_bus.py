"""The bus of `arctrack serve --simulated`: others hear it; without a network the cure is named."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys

import pytest

from arctrack.live.serve.simulated import GROUP, INTERFACE, SimulatedCell
from arctrack.live.simulated_cell import MULTICAST_CURE
from arctrack.simulation.cell.weld.closed_loop import LoopPlan

pytestmark = pytest.mark.slow

PLAN = LoopPlan(joint="lap", length_mm=1000.0, rate_hz=10.0, size_px=(160, 120))
SERVE = "from arctrack.cli import main; main()"
TALK = f"""
from arctrack.live.simulated_cell import joined_bus
import can
options = {{"port": 43567, "hop_limit": 0}}
one, other = (joined_bus("{INTERFACE}", "{GROUP}", **options) for _ in range(2))
with one, other:
    one.send(can.Message(arbitration_id=0x123, data=b"hi", is_extended_id=False))
    print(other.recv(60.0).arbitration_id)
"""

needs_namespaces = pytest.mark.skipif(
    os.geteuid() != 0 or None in map(shutil.which, ("unshare", "ip")), reason="needs root, unshare and ip"
)


@pytest.mark.usefixtures("multicast")
def test_the_printed_command_hears_the_bus() -> None:
    with SimulatedCell(PLAN, f"heard-{os.getpid()}") as robot:
        python, *words = robot.listening.split()
        assert python == "python"
        listener = subprocess.Popen([sys.executable, "-u", *words], stdout=subprocess.PIPE, text=True)
        try:
            assert any(" ID: " in line for line in listener.stdout)
        finally:
            listener.kill()
            listener.communicate()


@needs_namespaces
def test_without_a_network_the_cure_is_named_and_cures() -> None:
    serve = [sys.executable, "-c", SERVE, "serve", "--simulated", "--seconds", "1"]
    refused = subprocess.run(["unshare", "-n", *serve], capture_output=True, text=True)
    assert refused.returncode == 2
    # A slow machine's gets lines before it on how far it is.
    *_, line = refused.stderr.splitlines()
    assert line == f"arctrack: error: --bus {INTERFACE}:{GROUP}: No such device; {MULTICAST_CURE}"
    cure = MULTICAST_CURE.rpartition("as root: ")[2]
    talk = ["unshare", "-n", "sh", "-c", f"{cure}; exec {sys.executable} -c {shlex.quote(TALK)}"]
    cured = subprocess.run(talk, capture_output=True, text=True)
    assert (cured.returncode, cured.stdout) == (0, f"{0x123}\n"), cured.stderr
