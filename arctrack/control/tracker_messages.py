"""Messages of a tracker: a track's, the layout's version and the heartbeat."""

import math
from dataclasses import replace

import numpy as np

from noise_model.compiled.arrays import Float64
from robot_io import (
    BusMessage,
    CommandHeard,
    DbcVersion,
    GateLimits,
    GateReason,
    JointType,
    Proposal,
    SeamGeometry,
    SeamPoint,
    Source,
    TrackerHeartbeat,
    TrackerState,
    TrackerStatus,
    cycle_time_s,
    dbc_version,
    message_layout,
    out_of_range_as_unknown,
)
from robot_io.offset_use import COUNTING
from tracker import flags
from tracker.state import NAN, Track

UNKNOWN_POINT = SeamPoint(NAN, NAN, NAN)
"""Unknown position of the seam."""

NO_TRACK = Track(0, NAN, 0)
"""Placeholder of the newest track before the first."""


def has(track: Track, flag: flags.Flag) -> bool:
    """Return True if a track has a flag."""
    return bool(track.flags & flag.mask)


def proposal(track: Track, zero_mm: tuple[float, float]) -> Proposal:
    """Return a track's proposed offset, relative to the displacement (y, z) that counts as zero, mm."""
    return Proposal(
        captured_at_s=track.timestamp_s,
        offset_y_mm=track.offset_y_mm - zero_mm[0],
        offset_z_mm=track.offset_z_mm - zero_mm[1],
        confidence=track.offset_confidence,
        sigma_y_mm=track.offset_sigma_y_mm,
        sigma_z_mm=track.offset_sigma_z_mm,
    )


def displacement(
    track: Track, limits: GateLimits, enabled: tuple[bool, bool], now_s: float
) -> tuple[float, float] | None:
    """Return the seam's displacement (y, z), mm, 0 for an axis that is not enabled.

    None where the track is too old, or its sigma exceeds the gate's limits.
    """
    is_fresh = track.valid and 0.0 <= now_s - track.timestamp_s <= limits.capture_age_s
    if not (is_fresh and track.offset_confidence >= limits.confidence):
        return None
    axes = (
        (track.offset_y_mm, limits.range_y_mm, track.offset_sigma_y_mm, limits.sigma_y_mm),
        (track.offset_z_mm, limits.range_z_mm, track.offset_sigma_z_mm, limits.sigma_z_mm),
    )
    displaced_mm = [0.0, 0.0]
    for n, (offset_mm, range_mm, sigma_mm, sigma_limit_mm) in enumerate(axes):
        if enabled[n]:
            if not (abs(offset_mm) <= range_mm and 0.0 <= sigma_mm <= sigma_limit_mm):
                return None
            displaced_mm[n] = offset_mm
    return displaced_mm[0], displaced_mm[1]


def geometry(track: Track, joint: JointType) -> SeamGeometry:
    """Return the measured geometry of a joint."""
    measured = SeamGeometry(
        gap_mm=track.gap_mm,
        mismatch_mm=track.mismatch_mm,
        sigma_y_mm=track.sigma_y_mm,
        sigma_z_mm=track.sigma_z_mm,
        joint=joint if track.valid else JointType.UNKNOWN,
    )
    return out_of_range_as_unknown(measured)


def seam_point(track: Track, T_base_tool: Float64 | None) -> SeamPoint:
    """Return the seam point under the laser, unknown without a valid track or a pose (4, 4)."""
    if not track.valid or T_base_tool is None:
        return UNKNOWN_POINT
    x_mm, y_mm, z_mm = (T_base_tool @ np.array([*track.seam_tool_mm, 1.0]))[:3]
    point = out_of_range_as_unknown(SeamPoint(float(x_mm), float(y_mm), float(z_mm)))
    # A point has three coordinates or none.
    return UNKNOWN_POINT if any(map(math.isnan, (point.x_mm, point.y_mm, point.z_mm))) else point


def status(
    track: Track,
    state: TrackerState,
    reason: GateReason,
    is_robot_stale: bool,
    latency_ms: float,
    dropped: int,
) -> TrackerStatus:
    """Return the tracker's status; `dropped` counts the frames that it has not seen since the start."""
    return out_of_range_as_unknown(
        TrackerStatus(
            state=state,
            gate_reason=reason,
            frame_unreadable=has(track, flags.FRAME_UNREADABLE),
            stripe_lost=has(track, flags.STRIPE_LOST),
            joint_not_found=has(track, flags.JOINT_NOT_FOUND),
            saturated=has(track, flags.SATURATED),
            arc_map_distrusted=has(track, flags.MAP_MISFIT),
            pose_extrapolated=has(track, flags.POSE_EXTRAPOLATED),
            pose_refused=has(track, flags.POSE_REFUSED),
            robot_stale=is_robot_stale,
            arc_level=track.arc_level,
            map_misfit=track.map_misfit,
            dropped_frames_mod256=dropped % 256,
            latency_ms=latency_ms,
        )
    )


class HeartbeatSchedule:
    """Schedule of version and heartbeat messages; both are due at first.

    A heartbeat is due at once where it changes whether offsets count or which command is obeyed: a robot that
    heard of it late would join in the middle of a soft start.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._due_at_s = {DbcVersion: NAN, TrackerHeartbeat: NAN}
        self._rolling = 0
        self._state_sent: tuple[bool, CommandHeard] | None = None

    def hurry(self) -> None:
        """Let the next heartbeat be due at once."""
        self._due_at_s[TrackerHeartbeat] = NAN

    def due(self, heartbeat: TrackerHeartbeat, now_s: float) -> list[BusMessage]:
        """Return version and heartbeat where their time, s, has come; the heartbeat with its number."""
        state_sent = heartbeat.state in COUNTING, heartbeat.command_heard
        if state_sent != self._state_sent:
            self._state_sent = state_sent
            self.hurry()
        due: list[BusMessage] = []
        for kind, due_at_s in self._due_at_s.items():
            cycle_s = cycle_time_s(message_layout(kind.__name__))
            # Written so that it is due at first, and where the clock has run backwards.
            if 0.0 < due_at_s - now_s <= cycle_s:
                continue
            # The beat is kept, but nothing is made up for.
            on_time = 0.0 <= now_s - due_at_s < cycle_s
            self._due_at_s[kind] = (due_at_s if on_time else now_s) + cycle_s
            due.append(dbc_version(self._source) if kind is DbcVersion else self._numbered(heartbeat))
        return due

    def _numbered(self, heartbeat: TrackerHeartbeat) -> TrackerHeartbeat:
        self._rolling = (self._rolling + 1) % 256
        return replace(heartbeat, rolling=self._rolling)
