"""Tracks onto the bus: every one passes the gate, and what the gate decides is what the robot hears."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

from robot_io import (
    Conditions,
    DbcVersion,
    Decision,
    GateLimits,
    GateReason,
    JointType,
    LastSent,
    Link,
    Proposal,
    RobotStatus,
    SeamGeometry,
    SeamOffset,
    TrackerState,
    TrackerStatus,
    Verdict,
    cycle_time_s,
    dbc_version,
    decide,
    message_layout,
    out_of_range_as_unknown,
)
from tracker import flags
from tracker.seam.correction import UNSTATED, Correction
from tracker.state import Track

LIMITS = GateLimits(
    range_y_mm=10.0,
    range_z_mm=10.0,
    rate_y_mm_s=20.0,
    rate_z_mm_s=20.0,
    capture_age_s=0.2,
    confidence=0.1,
    hold_s=1.0,
)
"""What an offset must keep to unless the user says otherwise.

The confidence asked for is low on purpose: a hand-eye tolerance of some 0.05 degrees alone holds that of a
perfect measurement near a half, and that part of the error is constant.
"""


@dataclass(frozen=True)
class Moment:
    """When a track is published, and what the robot then does.

    Parameters
    ----------
    now_s : float
        The time, s, on the clock of the captures.
    robot : RobotStatus or None
        The robot's status; None while no fresh status has been received.
    latency_ms : float
        How long the track took, ms; NaN if nobody timed it.
    logged_at_s : float, optional
        The time that the bus' log gives the messages, s; by default the wall clock.
    """

    now_s: float
    robot: RobotStatus | None
    latency_ms: float = math.nan
    logged_at_s: float | None = None


class Publisher:
    """Sends seam offset, seam geometry and tracker status for each track.

    Its state is what the gate remembers.

    Parameters
    ----------
    link : Link
        The bus.
    joint_type : str
        The joint's type, which the seam geometry states.
    limits : GateLimits
        What an offset must keep to.
    correction : Correction
        Which axes are corrected.
    """

    def __init__(
        self,
        link: Link,
        joint_type: str,
        limits: GateLimits = LIMITS,
        correction: Correction = UNSTATED,
    ) -> None:
        self._link = link
        self._correction = correction
        self._joint = JointType[joint_type.upper()]
        self._limits = limits
        self._last_sent = LastSent()
        self._introduced_at_s = math.nan
        self._introduce_every_s = cycle_time_s(message_layout(DbcVersion.__name__))
        self.verdicts: Counter[Verdict] = Counter()
        self.reasons: Counter[GateReason] = Counter()

    def publish(self, track: Track, moment: Moment) -> SeamOffset:
        """Send a track's messages.

        Parameters
        ----------
        track : Track
            A frame's result.
        moment : Moment
            When it is sent, and what the robot then does.

        Returns
        -------
        SeamOffset
            The offset as it went out.

        Raises
        ------
        LinkError
            If the bus fails.
        BusLogError
            If a log fails.
        """
        # Written so that it is due at first, and where the clock has run backwards.
        if not 0.0 <= moment.now_s - self._introduced_at_s < self._introduce_every_s:
            self._link.send(dbc_version(), moment.logged_at_s)
            self._introduced_at_s = moment.now_s
        decision = self._decide(track, moment)
        self._link.send(decision.message, moment.logged_at_s)
        # Only now does the robot follow it: what did not go out is nothing to hold.
        self._last_sent = decision.last_sent
        self.verdicts[decision.verdict] += 1
        if decision.reason is not GateReason.NONE:
            self.reasons[decision.reason] += 1
        for message in (self._geometry(track), _status(track, decision, moment)):
            self._link.send(message, moment.logged_at_s)
        return decision.message

    def _decide(self, track: Track, moment: Moment) -> Decision:
        proposal = Proposal(
            captured_at_s=track.timestamp_s,
            offset_y_mm=track.offset_y_mm,
            offset_z_mm=track.offset_z_mm,
            confidence=track.offset_confidence,
            sigma_y_mm=track.offset_sigma_y_mm,
            sigma_z_mm=track.offset_sigma_z_mm,
        )
        enable_y, enable_z = self._correction.enabled
        # A tracker that has stopped following is not to be held to its last offset: the gate refuses at once.
        conditions = Conditions(
            armed=not _has_stopped(track), enable_y=enable_y, enable_z=enable_z, robot=moment.robot
        )
        return decide(proposal, conditions, self._limits, self._last_sent, moment.now_s)

    def _geometry(self, track: Track) -> SeamGeometry:
        measured = SeamGeometry(
            gap_mm=track.gap_mm,
            mismatch_mm=track.mismatch_mm,
            sigma_y_mm=track.sigma_y_mm,
            sigma_z_mm=track.sigma_z_mm,
            joint=self._joint if track.valid else JointType.UNKNOWN,
        )
        return out_of_range_as_unknown(measured)


def _status(track: Track, decision: Decision, moment: Moment) -> TrackerStatus:
    def has(flag: flags.Flag) -> bool:
        return bool(track.flags & flag.mask)

    status = TrackerStatus(
        state=_state(track, decision),
        gate_reason=decision.reason,
        frame_unreadable=has(flags.FRAME_UNREADABLE),
        stripe_lost=has(flags.STRIPE_LOST),
        joint_not_found=has(flags.JOINT_NOT_FOUND),
        saturated=has(flags.SATURATED),
        arc_map_distrusted=has(flags.MAP_MISFIT),
        pose_extrapolated=has(flags.POSE_EXTRAPOLATED),
        pose_refused=has(flags.POSE_REFUSED),
        robot_stale=moment.robot is None,
        arc_level=track.arc_level,
        map_misfit=track.map_misfit,
        dropped_frames_mod256=0,
        latency_ms=moment.latency_ms,
    )
    return out_of_range_as_unknown(status)


def _has_stopped(track: Track) -> bool:
    return bool(track.flags & flags.FOLLOW_STOPPED.mask)


def _state(track: Track, decision: Decision) -> TrackerState:
    if _has_stopped(track):
        return TrackerState.DISARMED
    if decision.verdict is Verdict.HOLD or track.flags & flags.OFFSET_HELD.mask:
        return TrackerState.HOLDING
    return TrackerState.TRACKING if track.valid else TrackerState.SEARCHING
