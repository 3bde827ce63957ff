"""All checks of a machine, and of a cell on it, in the order of their report."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arctrack.control.cell_file import CellFile, ProcessChoice
from arctrack.live.doctor.budget import (
    Budget,
    bandwidth_finding,
    budget_finding,
    budget_of,
    image_bytes,
    step_findings,
)
from arctrack.live.doctor.bus import bus_findings
from arctrack.live.doctor.camera import CameraReading, camera_findings
from arctrack.live.doctor.clocks import (
    clock_findings,
    processor_finding,
    processor_wait,
    wake_up_finding,
    wake_ups,
)
from arctrack.live.doctor.finding import DoctorFinding, FindingState
from arctrack.live.doctor.host import (
    disk_finding,
    own_memory_lock_finding,
    own_receive_buffer_finding,
    scheduler_findings,
    shared_memory_finding,
    versions_finding,
)
from arctrack.live.doctor.policy import POLICY
from arctrack.live.doctor.steps import FRAMES, NotCompiledError, StepTimes, require_compiled, time_steps
from arctrack.live.journal.journal import journal_bytes
from tracker.tracker import Tracker

GIGE = "gige"

Steps = Callable[[str, int], Callable[[int], None]]
"""Begins to show how far a stage is, by its name and by how many steps it has."""


@dataclass
class Examination:
    """Results of a cell's checks other than findings: the latency budget, where it is known."""

    budget: Budget | None = None


def machine_findings(choice: ProcessChoice) -> Iterator[DoctorFinding]:
    """Yield the findings about the machine, for a process of that scheduling."""
    yield versions_finding()
    yield from clock_findings()
    yield from scheduler_findings(choice)
    yield processor_finding(processor_wait(choice))


def examine_machine(folder: Path) -> Iterator[DoctorFinding]:
    """Yield the findings about a machine without a cell."""
    choice = ProcessChoice()
    yield from machine_findings(choice)
    yield wake_up_finding(wake_ups(choice), choice)
    yield own_memory_lock_finding(0, is_asked=False)
    yield disk_finding(folder)


def examine_cell(
    cell: CellFile, steps: Steps, examination: Examination, **bus_options: Any
) -> Iterator[DoctorFinding]:
    """Yield the findings about a machine that is to run a cell; nothing is sent, the laser stays off.

    `steps` shows progress, `examination` takes the other results, `bus_options` go to python-can.
    """
    setup, rate_hz, choice = cell.setup.setup, cell.camera.frame_rate_hz, cell.process
    yield from machine_findings(choice)
    late = wake_ups(choice)
    yield wake_up_finding(late, choice)
    times: list[StepTimes] = []
    for number in cell.jobs:
        for result in _job_findings(cell, number, steps):
            if isinstance(result, StepTimes):
                times.append(result)
            else:
                yield result
    kept_s = cell.black_box.seconds
    # The shared memory that a run takes itself; the ring of a camera's frames is the camera's.
    shared_bytes = (
        journal_bytes(kept_s, cell.camera.frame_rate_hz, image_bytes(cell.setup.setup)) if kept_s else 0
    )
    # By now this process holds all that a run's loop does.
    yield own_memory_lock_finding(shared_bytes, choice.lock_memory)
    yield shared_memory_finding(shared_bytes)
    yield disk_finding(cell.path.parent / cell.black_box.folder)
    yield bandwidth_finding(setup, rate_hz, cell.camera.kind == GIGE)
    if cell.camera.kind == GIGE:
        yield own_receive_buffer_finding(image_bytes(setup))
    watched: CameraReading | None = None
    for reading in camera_findings(cell):
        if isinstance(reading, CameraReading):
            watched = reading
        else:
            yield reading
    yield from bus_findings(cell, **bus_options)
    slowest = max(times, key=lambda job: job.tracked.p99_ms, default=None)
    examination.budget = budget_of(cell, slowest if len(times) == len(cell.jobs) else None, late, watched)
    yield budget_finding(examination.budget)


def _job_findings(cell: CellFile, number: int, steps: Steps) -> Iterator[DoctorFinding | StepTimes]:
    """Yield the findings about a job's tracker, and the durations of its steps."""
    job, name = cell.jobs[number], f"job {number}"
    try:
        tracker = Tracker(job.setup_for(cell.setup.setup), correction=job.correction)
    except ValueError as error:
        yield DoctorFinding(name, FindingState.FAILED, str(error), f"mend {cell.setup.path}")
        return
    try:
        require_compiled(tracker)
    except NotCompiledError as missing:
        text = f"{missing} is not compiled on this disk, or an update changed it"
        cure = f"arctrack warm {cell.path}: else the first start takes minutes"
        yield DoctorFinding(name, FindingState.WARNING, text, cure)
        return
    yield DoctorFinding(name, FindingState.OK, f"{job.name}: all that a step may need is compiled")
    on_done = steps(f"{name}: timing the tracker", FRAMES + POLICY.steps)
    times = time_steps(tracker, POLICY.steps, on_done)
    yield times
    yield from step_findings(number, times, cell.camera.frame_rate_hz)
