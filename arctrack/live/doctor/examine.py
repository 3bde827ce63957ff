"""All checks of a machine, and of a cell on it, in the order of their report; the budget of its latency."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from arctrack.control.cell_file import CellFile, ProcessChoice
from arctrack.live.doctor.bus import bus_findings
from arctrack.live.doctor.camera import CameraReading, camera_findings
from arctrack.live.doctor.clocks import (
    clock_findings,
    processor_finding,
    processor_wait,
    wake_up_finding,
    wake_ups,
)
from arctrack.live.doctor.finding import POLICY, DoctorFinding, FindingState, judged
from arctrack.live.doctor.host import (
    disk_finding,
    own_memory_lock_finding,
    own_receive_buffer_finding,
    scheduler_findings,
    shared_memory_finding,
    versions_finding,
)
from arctrack.live.doctor.steps import FRAMES, NotCompiledError, StepTimes, require_compiled, time_steps
from arctrack.live.journal.journal import journal_bytes
from arctrack.live.serve.latency import Quantiles
from arctrack.live.serve.loop import NEAR_S, TURN_S
from noise_model.setup import Setup
from robot_io import RobotPosePosition, cycle_time_s, message_layout
from robot_io.protocol.bus_load import frame_bits, min_frame_bits, response_time_s
from tracker.tracker import Tracker

SERIAL_LINE_S = 0.0023
"""A frame over a serial adapter at 115200 bit/s: 26 characters of ten bits."""


@dataclass(frozen=True)
class LatencyPart:
    """Part of the latency from mid-exposure to offset: median, maximum, and source of both."""

    name: str
    typical_s: float
    at_most_s: float
    source: str


@dataclass(frozen=True)
class Budget:
    """The parts in their order, and the oldest capture that the gate lets out, s."""

    parts: tuple[LatencyPart, ...]
    capture_age_s: float

    @property
    def typical_s(self) -> float:
        """The sum in the middle, s."""
        return sum(part.typical_s for part in self.parts)

    @property
    def at_most_s(self) -> float:
        """The sum of what each takes at most, s."""
        return sum(part.at_most_s for part in self.parts)


def pixel_bytes(setup: Setup) -> int:
    """Return the bytes of a pixel as it lies in memory."""
    return int(np.dtype(setup.sensor.dtype).itemsize)


def image_bytes(setup: Setup) -> int:
    """Return the bytes of an image as it lies in memory."""
    return math.prod(setup.frame_shape) * pixel_bytes(setup)


def transfer_s(n_bytes: int) -> float:
    """Return the time that gigabit Ethernet takes for `n_bytes` of an image, s."""
    return n_bytes / POLICY.ethernet_payload_bytes_s


def max_rows(width: int, bytes_per_pixel: int, rate_hz: float) -> int:
    """Return the number of image rows that gigabit Ethernet carries at a frame rate."""
    return math.floor(POLICY.ethernet_payload_bytes_s / (rate_hz * width * bytes_per_pixel))


def budget_of(
    cell: CellFile, steps: StepTimes | None, late: Quantiles, watched: CameraReading | None = None
) -> Budget:
    """Return the latency budget from a frame's mid-exposure until its offset is on the bus.

    Without `steps` their times are NaN. `late` is how late this machine wakes up. With `watched`, what the
    live camera gave, the latency up to the loop is measured instead of computed.
    """
    way = _way(cell.setup.setup, watched)
    turn = LatencyPart(
        "turn of the loop", NEAR_S, TURN_S + 1e-3 * late.p99_ms, "waits for a message meanwhile"
    )
    came = (*way, turn)
    pose = _pose(cell, came)
    if steps is None:
        step = LatencyPart("step of the tracker", math.nan, math.nan, "not compiled: not measured")
    else:
        took = (1e-3 * steps.tracked.p50_ms, 1e-3 * max(steps.tracked.p99_ms, steps.searched.p99_ms))
        step = LatencyPart("step of the tracker", *took, "measured: tracking, and 99 % of a search")
    return Budget((*came, pose, step, *_bus(cell)), cell.limits.capture_age_s)


def _way(setup: Setup, watched: CameraReading | None) -> tuple[LatencyPart, ...]:
    """Return what lies between mid-exposure and the frame's arrival."""
    if watched is not None:
        age = watched.age
        return (LatencyPart("mid-exposure to arrival", 1e-3 * age.p50_ms, 1e-3 * age.max_ms, "measured"),)
    half_s, n_bytes = setup.camera.exposure_s / 2.0, image_bytes(setup)
    sent_s = transfer_s(n_bytes)
    return (
        LatencyPart("half of the exposure", half_s, half_s, "the setup"),
        LatencyPart(
            "transfer", sent_s, sent_s, f"{n_bytes} bytes over gigabit Ethernet; the camera's own are more"
        ),
    )


def _pose(cell: CellFile, came: tuple[LatencyPart, ...]) -> LatencyPart:
    """Return the wait for the pose after the capture: it runs while the frame is on its way."""
    period_s = cycle_time_s(message_layout(RobotPosePosition.__name__))
    sent_s = 0.0 if cell.bus.is_port else 2 * frame_bits() / cell.bus.bit_rate_bit_s
    wait_s, came_s = cell.policy.pose_wait_s, sum(part.typical_s for part in came)
    typical_s = max(0.0, min(period_s / 2.0 + sent_s, wait_s) - came_s)
    return LatencyPart(
        "wait for the pose", typical_s, max(0.0, wait_s - came_s), "beyond the frame's own way"
    )


def _bus(cell: CellFile) -> tuple[LatencyPart, ...]:
    rate, bit_rate = cell.camera.frame_rate_hz, cell.bus.bit_rate_bit_s
    if cell.bus.is_port:
        cycle_s = cycle_time_s(message_layout(RobotPosePosition.__name__))
        return (LatencyPart("port", cycle_s / 2.0, cycle_s, "the robot's next report, which is answered"),)
    answered = response_time_s("SeamOffset", rate, bit_rate)
    least, most = min_frame_bits(), frame_bits()
    text = f"{answered.frames} frames at most, each of {least} to {most} bits"
    bus = LatencyPart("bus", (least + most) / 2.0 / bit_rate, answered.time_s, text)
    if cell.bus.interface != "slcan":
        return (bus,)
    return LatencyPart("serial adapter", SERIAL_LINE_S, 2.0 * SERIAL_LINE_S, "at 115200 bit/s"), bus


def budget_finding(budget: Budget) -> DoctorFinding:
    """Hold a budget against the oldest capture that the gate lets out."""
    text = (
        f"{1e3 * budget.typical_s:.1f} ms, {1e3 * budget.at_most_s:.1f} ms at most; "
        f"[gate] capture_age_s lets out {1e3 * budget.capture_age_s:.0f} ms"
    )
    if math.isnan(budget.typical_s):
        return DoctorFinding(
            "latency", FindingState.WARNING, "not known without the step's time", "arctrack warm"
        )
    problem = FindingState.FAILED if budget.typical_s > budget.capture_age_s else FindingState.WARNING
    cure = "shorten the largest part of the table"
    return judged("latency", text, problem, cure, budget.at_most_s <= budget.capture_age_s)


def bandwidth_finding(setup: Setup, rate_hz: float, is_ethernet: bool) -> DoctorFinding:
    """Find the share of a gigabit line that a camera's images take; too much fails on Ethernet."""
    (height, width), n_bytes = setup.frame_shape, pixel_bytes(setup)
    sent_s, rows = transfer_s(image_bytes(setup)), max_rows(width, n_bytes, rate_hz)
    return judged(
        "bandwidth",
        f"{height} rows of {width} px, {8 * n_bytes} bit, {rate_hz:g} a second take "
        f"{100.0 * rate_hz * sent_s:.0f} % of gigabit Ethernet, {1e3 * sent_s:.1f} ms each",
        FindingState.FAILED if is_ethernet else FindingState.WARNING,
        f"it carries {rows} rows at this rate: read fewer, or use a faster line",
        height <= rows,
    )


def step_findings(number: int, steps: StepTimes, rate_hz: float) -> tuple[DoctorFinding, ...]:
    """Find whether a job's steps keep up with the camera, and whether its own frames are tracked."""
    return (
        judged(
            f"job {number}",
            f"a step takes {steps.tracked}; a search {steps.searched}",
            FindingState.WARNING,
            "frames would be dropped: fewer rows, fewer frames a second, or a faster machine",
            1e-3 * steps.tracked.p99_ms * rate_hz <= 1.0,
        ),
        judged(
            f"job {number}",
            f"{100.0 * steps.valid_share:.0f} % of frames drawn of the setup itself are tracked",
            FindingState.WARNING,
            "the setup does not show its own joint: arctrack plan says why",
            steps.valid_share > 0.5,
        ),
    )


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
