"""Status of a run for the page: numbers with their units, None where one is unknown."""

import math
from collections import deque
from typing import Any

from arctrack.control.processor import MAX_WAIT_SHARE
from arctrack.live.journal.records import Entry, GapReport, Status
from arctrack.live.monitor.options import MonitorOptions
from arctrack.live.monitor.words import LASERS, Indication, headline, indication_of, plain
from robot_io import RobotStatus, Source, Switch, TrackerState, Validity
from tracker.arc.level import ArcLevel

SHOWN_S = 180.0
"""Length of the page's charts, s."""

USABLE = (Validity.VALID, Validity.HELD)
"""A robot may follow these offsets alone."""

Number = float | None
Point = tuple[float, Number, Number, Number, Number, str, Number, Number]
"""Time, s; offset y and its sigma, z and its sigma, mm; validity; mid-exposure to send, and the step, ms."""


class FrameRate:
    """Frame rate over the latest statuses; `hz` is NaN where it is unknown."""

    def __init__(self) -> None:
        self._counts: deque[tuple[float, int]] = deque()
        self.hz = math.nan

    def add(self, status: Status) -> None:
        """Take a status."""
        self._counts.append((status.now_s, status.frames))
        while self._counts[-1][0] - self._counts[0][0] > 2.0 and len(self._counts) > 2:
            self._counts.popleft()
        (first_s, first), (last_s, last) = self._counts[0], self._counts[-1]
        self.hz = (last - first) / (last_s - first_s) if last_s > first_s else math.nan


class OffsetFlow:
    """Age of the last offset that the robot may use, s before the newest status; infinite without one."""

    def __init__(self) -> None:
        self._count = 0
        self._sent_s = -math.inf
        self.age_s = math.inf

    def add(self, status: Status) -> None:
        """Take a status."""
        count = sum(status.offsets.get(validity.name, 0) for validity in USABLE)
        if count != self._count:
            self._count, self._sent_s = count, status.now_s
        self.age_s = status.now_s - self._sent_s


def indicated(status: Status, offset_age_s: float) -> Indication:
    """Return what a status indicates; see `indication_of`."""
    command = None if status.command is None else status.command.command
    validity = None if status.offset is None else status.offset.validity
    return indication_of(status.state, command, validity, offset_age_s)


def number(value: float, digits: int = 3) -> Number:
    """Return a number to some digits, None where it is not known."""
    return round(value, digits) if math.isfinite(value) else None


def point_of(entry: Entry) -> Point:
    """Return what the charts show of an entry: what went out, where it may be used."""
    offset, track = entry.offset, entry.track
    validity = Validity.REFUSED if offset is None else offset.validity
    y = z = sigma_y = sigma_z = math.nan
    if offset is not None and validity in USABLE:
        y, z = offset.offset_y_mm, offset.offset_z_mm
    if validity is Validity.VALID:
        sigma_y, sigma_z = track.offset_sigma_y_mm, track.offset_sigma_z_mm
    return (
        round(entry.frame.timestamp_s, 4),
        number(y),
        number(sigma_y, 4),
        number(z),
        number(sigma_z, 4),
        validity.name,
        number(1000.0 * (entry.sent_s - entry.frame.timestamp_s), 2),
        number(entry.took_ms, 2),
    )


def status_content(
    options: MonitorOptions,
    status: Status | None,
    gap: GapReport | None,
    arc: ArcLevel | None,
    rate_hz: float,
    offset_age_s: float,
    point: Point | None,
) -> dict[str, Any]:
    """Return a run's status for browsers; before the first status only that it starts."""
    if status is None:
        starting = TrackerState.STARTING.name
        return {"kind": "status", "state": starting, "indication": starting, "reason": "The tracker starts."}
    indication = indicated(status, offset_age_s)
    is_simulated = options.is_simulated or status.source is Source.SIMULATION
    offset = status.offset
    is_out = offset is not None and offset.validity in USABLE
    is_valid = offset is not None and offset.validity is Validity.VALID
    return {
        "kind": "status",
        "now_s": status.now_s,
        "wall_s": status.wall_s,
        "source": "SIMULATED" if is_simulated else status.source.name,
        "state": status.state.name,
        "indication": indication.name,
        "fault": status.fault.name,
        "reason_name": status.reason.name,
        "reason": headline(
            status.state, status.fault, status.reason, indication, status.processor_wait > MAX_WAIT_SHARE
        ),
        "laser": LASERS[status.laser],
        "job": {"number": status.job_number, "name": options.job_names.get(status.job_number, "")},
        "frames": status.frames,
        "valid": status.valid,
        "dropped": status.dropped,
        "rate_hz": number(rate_hz, 1),
        "processor_wait": number(status.processor_wait, 2),
        "is_too_busy": status.processor_wait > MAX_WAIT_SHARE,
        "frame_age_s": number(status.now_s - status.frame_s),
        "capture_ms": [number(ms, 1) for ms in status.capture_ms],
        "arrival_ms": [number(ms, 1) for ms in status.arrival_ms],
        "validity": None if offset is None else offset.validity.name,
        "usable_offset_age_s": number(offset_age_s),
        "offset_y_mm": number(offset.offset_y_mm) if offset is not None and is_out else None,
        "offset_z_mm": number(offset.offset_z_mm) if offset is not None and is_out else None,
        "sigma_y_mm": point[2] if point is not None and is_valid else None,
        "sigma_z_mm": point[4] if point is not None and is_valid else None,
        "offsets": dict(status.offsets),
        "reasons": dict(status.reasons),
        "bus_faults": dict(status.faults),
        "robot": _robot(status.robot),
        "processes": {
            name: {
                "pid": state.pid,
                "running": state.is_running,
                "ended": state.ends,
                "problem": state.problem or None,
            }
            for name, state in status.processes.items()
        },
        "command": None if status.command is None else plain(status.command.command.name),
        "arc": _arc(gap, arc),
        "gap": None if gap is None else _gap(gap),
    }


def _arc(gap: GapReport | None, arc: ArcLevel | None) -> dict[str, Number | bool]:
    """Return the arc's level in the newest view, and its height by the gap watch."""
    level, sigma, misfit = (
        (arc.level, arc.sigma, arc.misfit)
        if arc is not None and arc.is_on
        else (math.nan, math.nan, math.nan)
    )
    return {
        "is_on": None if arc is None else arc.is_on,
        "level": number(level),
        "level_sigma": number(sigma, 4),
        "misfit": number(misfit, 2),
        "height_mm": None if gap is None else number(gap.arc_height_mm, 2),
        "height_sigma_mm": None if gap is None else number(gap.arc_height_sigma_mm, 3),
    }


def _gap(gap: GapReport) -> dict[str, Any]:
    return {"is_gap": gap.is_gap, "text": gap.text, "since_wall_s": number(gap.since_wall_s, 0)}


def _robot(robot: RobotStatus | None) -> dict[str, Any] | None:
    """Return what the robot said last, in words, with what is wrong of it."""
    if robot is None:
        return None
    return {
        "mode": plain(robot.mode.name),
        "motion": plain(robot.motion.name),
        "welding": plain(robot.welding.name),
        "arc": plain(robot.arc.name),
        "correction": plain(robot.correction.name),
        "emergency_stop": robot.emergency_stop is Switch.ON,
        "current_a": number(robot.current_a, 1),
        "speed_mm_s": number(robot.travel_speed_mm_s, 2),
    }
