"""Fault schedules drawn from a seed, run, and judged by every frame that reaches the robot."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from arctrack.simulation.cell.cell import TORCH_MM
from arctrack.workers import processes
from robot_io import GateLimits, GateReason, Validity
from validation.fault_schedules.failures import LONGEST_S
from validation.fault_schedules.fault_kind import FaultKind
from validation.fault_schedules.judged_cell import USABLE, JudgedCell, ReceivedOffset
from validation.fault_schedules.kinds import KINDS
from validation.fault_schedules.worlds import draw_world

BEGIN_S = (1.0, 1.3)
"""When a fault begins, s."""

SETTLED_S = 0.2
"""For so long before the end offsets must be VALID again."""

WAY_S = 0.01
"""What the way on the bus and the robot's own cycle may take."""


@dataclass(frozen=True)
class ScheduleOutcome:
    """What became of one schedule.

    Attributes
    ----------
    number : int
        Its number among those of the seed.
    fault : str
        What went wrong.
    broken : tuple of str
        What did not hold, a line each.
    stop_s : float
        When the last offset was usable, after the fault's begin, s; NaN where offsets went on.
    torch_error_mm : float
        How far the torch was off the seam at most, from the fault's begin on, mm.
    reasons : frozenset of str
        What the tracker said while it lasted.
    """

    number: int
    fault: str
    broken: tuple[str, ...]
    stop_s: float
    torch_error_mm: float
    reasons: frozenset[str] = field(default_factory=frozenset)


@dataclass(frozen=True)
class Schedule:
    """A fault and its times, s."""

    kind: FaultKind
    begin_s: float
    end_s: float


def run_schedule(seed: int, number: int, kinds: Sequence[FaultKind] = KINDS) -> ScheduleOutcome:
    """Draw a schedule, run it, and judge it.

    Parameters
    ----------
    seed, number : int
        Which schedule: the same two give the same run.
    kinds : sequence of FaultKind
        What may go wrong; each number has the next of them.

    Returns
    -------
    Outcome
        What became of it.
    """
    rng = np.random.default_rng([seed, number])
    kind = kinds[number % len(kinds)]
    begin_s = 0.0 if kind.from_start else float(rng.uniform(*BEGIN_S))
    lasts_s = float(rng.uniform(0.2, LONGEST_S))
    world = draw_world(rng)
    if kind.lasts_s is not None:
        lasts_s = kind.lasts_s(world)
    end_s = 1.3 + lasts_s if kind.from_start else begin_s + lasts_s
    schedule = Schedule(kind, begin_s, end_s)
    cell = JudgedCell(world, rng)

    def begin() -> None:
        cell.scheduler.at(end_s, kind.begin(cell, rng))

    cell.scheduler.at(begin_s, begin)
    until_s = end_s + kind.recovery_s
    cell.run(until_s)
    broken = tuple(_broken(cell, schedule, until_s))
    usable_s = [
        h.sent_s for h in cell.received if begin_s <= h.sent_s < end_s and h.offset.validity in USABLE
    ]
    went_on = bool(usable_s) and usable_s[-1] > end_s - 0.05
    return ScheduleOutcome(
        number=number,
        fault=kind.name,
        broken=broken,
        stop_s=math.nan if went_on else (usable_s[-1] - begin_s if usable_s else 0.0),
        torch_error_mm=max(e for t_s, e in cell.torch_error_mm if t_s >= max(begin_s, 0.9)),
        reasons=frozenset(r.name for t_s, r in cell.reasons if begin_s <= t_s < end_s and r),
    )


def run_schedules(seed: int, count: int, executor: Executor | None = None) -> Iterator[ScheduleOutcome]:
    """Run schedules 0 to count - 1 of a seed, several at a time where an executor is given."""
    if executor is None:
        for number in range(count):
            yield run_schedule(seed, number)
        return
    yield from executor.map(run_schedule, [seed] * count, range(count))


@contextmanager
def executor(workers: int) -> Iterator[Executor | None]:
    """Give an executor of so many processes, None for this process alone."""
    if workers == 1:
        yield None
        return
    with processes(workers) as pool:
        yield pool


def _broken(cell: JudgedCell, schedule: Schedule, until_s: float) -> Iterator[str]:
    """Yield what did not hold, each once."""
    usable = [h for h in cell.received if h.offset.validity in USABLE]
    for name, is_broken in (
        ("an offset out of range", _is_beyond),
        ("an offset too old", lambda h, limits: _is_too_old(h, limits, schedule.kind.is_slow_bus)),
        ("an offset of no capture", lambda h, _: math.isnan(h.true_capture_s)),
    ):
        bad = next((h for h in usable if is_broken(h, cell.job.limits)), None)
        if bad is not None:
            yield f"{name} at {bad.came_s:.3f} s: {bad.offset}"
    yield from _wrongly_told(cell, schedule, usable)
    yield from _not_recovered(cell, schedule.kind, until_s)


def _is_beyond(received: ReceivedOffset, limits: GateLimits) -> bool:
    y_mm, z_mm = received.offset.offset_y_mm, received.offset.offset_z_mm
    return abs(y_mm) > limits.range_y_mm or abs(z_mm) > limits.range_z_mm


def _is_too_old(received: ReceivedOffset, limits: GateLimits, is_slow_bus: bool) -> bool:
    limit_s = limits.capture_age_s if received.offset.validity is Validity.VALID else limits.hold_s
    known_s = received.sent_s if is_slow_bus else received.came_s
    return known_s - received.true_capture_s > limit_s + WAY_S


def _wrongly_told(cell: JudgedCell, schedule: Schedule, usable: Sequence[ReceivedOffset]) -> Iterator[str]:
    kind, end_s = schedule.kind, schedule.end_s
    if math.isnan(kind.stop_s):
        return
    stop_s = schedule.begin_s + kind.stop_s
    bad = next((h for h in usable if stop_s < h.sent_s < end_s), None)
    if bad is not None:
        yield f"usable {bad.sent_s - schedule.begin_s:.3f} s after the fault began: {bad.offset}"
    wrong = {r for t_s, r in cell.reasons if stop_s + WAY_S < t_s < end_s} - kind.reasons - {GateReason.NONE}
    if wrong and not kind.from_start:
        yield f"said {', '.join(sorted(r.name for r in wrong))}"


def _not_recovered(cell: JudgedCell, kind: FaultKind, until_s: float) -> Iterator[str]:
    last = cell.validities(until_s - SETTLED_S, until_s)
    if set(last) != {Validity.VALID}:
        said = {r.name for t_s, r in cell.reasons if t_s >= until_s - SETTLED_S}
        doubt = cell.tracker.poses.watch.doubt(cell.tracker.now_s)
        yield f"not VALID again at the end: {dict(last)}, {sorted(said)}, poses: {doubt}"
        return
    error_mm = cell.torch_error_mm[-1][1]
    if error_mm > TORCH_MM + kind.follows_mm:
        yield f"the torch is off by {error_mm:.2f} mm at the end"
