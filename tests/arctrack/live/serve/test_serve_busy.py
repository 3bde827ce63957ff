"""A live run on a machine that other processes keep busy: they work on its own processor."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from arctrack.control.cell_file import ProcessChoice
from arctrack.control.processor import SCHEDSTAT, TOO_BUSY, ProcessorWait
from arctrack.live.doctor.clocks import processor_finding, processor_wait
from arctrack.live.doctor.finding import FindingState

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not SCHEDSTAT.exists(), reason="this kernel does not tell who waits"),
]

SERVE = "from arctrack.cli import main; main()"
WORKERS = 6
PATIENCE_S = 120.0


@contextmanager
def busy(cpu: int) -> Iterator[None]:
    """Keep a processor busy."""
    work = f"import os\nos.sched_setaffinity(0, {{{cpu}}})\nprint(flush=True)\nwhile True: pass"
    command = [sys.executable, "-c", work]
    workers = [subprocess.Popen(command, stdout=subprocess.PIPE) for _ in range(WORKERS)]
    try:
        for worker in workers:
            worker.stdout.readline()
        yield
    finally:
        for worker in workers:
            worker.kill()
            worker.communicate()


def test_who_waits_for_a_processor_is_told_so() -> None:
    before = os.sched_getaffinity(0)
    cpu = min(before)
    with busy(cpu):
        finding = processor_finding(processor_wait(ProcessChoice(cpus=(cpu,))))
        os.sched_setaffinity(0, {cpu})
        try:
            wait, until_s = ProcessorWait(), time.monotonic() + PATIENCE_S
            while not wait.is_too_long:
                wait.look()
                assert time.monotonic() < until_s, (wait.share, wait.waited_s, wait.ran_s)
        finally:
            os.sched_setaffinity(0, before)
    assert finding.state is FindingState.WARNING
    assert "this machine is too busy" in str(finding)


@pytest.mark.usefixtures("multicast")
@pytest.mark.usefixtures("compiled")
def test_a_live_run_says_that_the_machine_is_too_busy(tmp_path) -> None:
    command = [sys.executable, "-c", SERVE, "serve", "--simulated"]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=tmp_path)
    try:
        lines = []
        while not (lines and lines[-1].startswith("ready: ")):
            lines.append(run.stdout.readline())
            assert lines[-1], lines
        cpu = min(os.sched_getaffinity(run.pid))
        children = subprocess.run(["pgrep", "-P", str(run.pid)], capture_output=True, text=True).stdout
        for process in (run.pid, *map(int, children.split())):
            os.sched_setaffinity(process, {cpu})
        with busy(cpu):
            assert run.stdout.readline() == f"arctrack: warning: {TOO_BUSY}\n"
        run.send_signal(signal.SIGTERM)
        said, _ = run.communicate(timeout=PATIENCE_S)
    finally:
        run.kill()
        run.communicate()
    assert "\nthis machine was too busy: " in said
    assert "\ntorch: " in said
