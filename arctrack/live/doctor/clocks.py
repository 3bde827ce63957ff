"""Checks of the machine's clocks, and of how late a sleep ends."""

import itertools
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from arctrack.control.cell_file import ProcessChoice
from arctrack.control.processor import ProcessorWait
from arctrack.live.doctor.finding import POLICY, DoctorFinding, FindingState, judged
from arctrack.live.serve.latency import LatencyCounts, Quantiles
from arctrack.live.serve.process import schedule
from arctrack.system import scheduling_kept

CLOCK_SOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")

SYNCHRONISED = Path("/run/systemd/timesync/synchronized")
READS = 2000


def clock_source_finding(source: str | None) -> DoctorFinding:
    """Return the finding about a kernel's clock source, None where it is unknown."""
    if source is None:
        return DoctorFinding("clock source", FindingState.OK, "not told by this kernel")
    # A reading of these takes a microsecond or more, or is as coarse as a tick.
    return judged(
        "clock source",
        source,
        FindingState.WARNING,
        "a slow clock delays each reading; boot with clocksource=tsc where the processor's is steady",
        source not in ("hpet", "acpi_pm", "jiffies", "refined-jiffies"),
    )


def clock_findings() -> Iterator[DoctorFinding]:
    """Yield the findings about the clocks."""
    try:
        source = CLOCK_SOURCE.read_text(encoding="ascii").strip()
    except OSError:
        source = None
    yield clock_source_finding(source)
    readings = [time.monotonic_ns() for _ in range(READS)]
    steps = [later - earlier for earlier, later in itertools.pairwise(readings) if later > earlier]
    step_s, read_s = 1e-9 * min(steps, default=0), 1e-9 * (readings[-1] - readings[0]) / (READS - 1)
    yield judged(
        "monotonic clock",
        f"steps of {1e9 * step_s:.0f} ns, a reading takes {1e9 * read_s:.0f} ns",
        FindingState.WARNING,
        "times of frames and poses are that coarse; look at the clock source",
        step_s <= POLICY.clock_step_s,
    )
    # Internal time is monotonic: only the dates of logs and recordings hang on the wall clock.
    is_set = "set from the network" if SYNCHRONISED.exists() else "not known to be set from the network"
    yield DoctorFinding("wall clock", FindingState.OK, f"{is_set}; only dates of logs hang on it")


@contextmanager
def scheduled_as(choice: ProcessChoice) -> Iterator[None]:
    """Have the scheduling that a run would have, as far as the machine allows it, and give it back."""
    with scheduling_kept():
        for wanted in (ProcessChoice(cpus=choice.cpus), ProcessChoice(priority=choice.priority)):
            # What is refused is a finding of its own.
            schedule(wanted)
        yield


def wake_ups(choice: ProcessChoice, count: int = POLICY.wake_ups) -> Quantiles:
    """Measure the lateness of sleeps of `wake_up_s`, scheduled as a run would be."""
    late = LatencyCounts()
    with scheduled_as(choice):
        for _ in range(count):
            began_s = time.monotonic()
            time.sleep(POLICY.wake_up_s)
            late.add(time.monotonic() - began_s - POLICY.wake_up_s)
    return late.quantiles()


def processor_wait(choice: ProcessChoice) -> ProcessorWait:
    """Measure how long work waits for a processor, scheduled as a run would be."""
    with scheduled_as(choice):
        wait, until_s = ProcessorWait(), time.monotonic() + POLICY.work_s
        while time.monotonic() < until_s:
            wait.look()
    return wait


def processor_finding(wait: ProcessorWait) -> DoctorFinding:
    """Return whether this machine is too busy for work to be done when it is due."""
    share = wait.waited_s / (wait.waited_s + wait.ran_s) if wait.ran_s > 0.0 else math.nan
    if math.isnan(share):
        return DoctorFinding("load", FindingState.OK, "not told by this kernel")
    return judged(
        "load",
        f"work waits for a processor {100.0 * share:.0f} % of its time",
        FindingState.WARNING,
        "this machine is too busy: frames and poses come late; end what else runs here",
        share <= POLICY.wait_share,
    )


def wake_up_finding(late: Quantiles, choice: ProcessChoice) -> DoctorFinding:
    """Return the finding about how late sleeps end: it must not add a turn to a frame's wait."""
    cure = "end what else runs here, or isolate a processor"
    if choice.priority is None:
        cure = f"state [process] priority, or {cure}"
    return judged(
        "wake-up",
        f"a sleep of {1e3 * POLICY.wake_up_s:g} ms ends late: {late}",
        FindingState.WARNING,
        cure,
        late.p99_ms <= 1e3 * POLICY.wake_up_s,
    )
