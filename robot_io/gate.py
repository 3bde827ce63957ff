"""Final gate before the bus: an offset is sent, the last one held, or the correction refused.

A refusal says that nothing may be corrected at all (not armed, emergency stop, no arc …). A hold says that
this one capture is unusable: the offset sent last is repeated, until its own capture is older than `hold_s`;
then the hold becomes a refusal with the same reason. An offset goes through as it was measured or not at all,
except for the soft start: from zero an axis approaches the seam at its rate limit, with a confidence of 0 and
the reason SOFT_START until it is there. All limits are inclusive: a value at its limit passes.
"""

import math
from dataclasses import dataclass, field, replace
from enum import Enum

from robot_io.gate_limits import GateLimits
from robot_io.protocol.codec import out_of_range_as_unknown
from robot_io.protocol.messages import (
    GateReason,
    MotionState,
    RobotMode,
    RobotStatus,
    SeamOffset,
    Switch,
    Validity,
    WeldingState,
)


class Verdict(Enum):
    """Verdict on a proposal."""

    SEND = "send"
    HOLD = "hold"
    REFUSE = "refuse"


@dataclass(frozen=True)
class Proposal:
    """An offset that wants to go out, at the torch's station, for the time of its capture.

    Parameters
    ----------
    captured_at_s : float
        The time of the capture, s, on the clock of the gate's `now_s`.
    offset_y_mm, offset_z_mm : float
        The offset, mm, joint frame; NaN where it was not measured.
    confidence : float
        The probability that the offset is within the weld's tolerance.
    sigma_y_mm, sigma_z_mm : float
        1 sigma of the offset, mm.
    """

    captured_at_s: float
    offset_y_mm: float
    offset_z_mm: float
    confidence: float
    sigma_y_mm: float
    sigma_z_mm: float


@dataclass(frozen=True)
class Conditions:
    """Conditions of an offset.

    Parameters
    ----------
    armed : bool
        True while the tracker may send offsets.
    enable_y, enable_z : bool
        Which axes are corrected.
    robot : RobotStatus or None
        The robot's last status; None while no fresh status has been received.
    fault : GateReason
        Reason that forbids every offset and is named before all others; NONE if there is none.
    doubt : GateReason
        Reason that forbids every offset and is named after the robot's own; NONE if there is none.
    hold : bool
        True if the robot wants the last offset to be held.
    """

    armed: bool
    enable_y: bool
    enable_z: bool
    robot: RobotStatus | None
    fault: GateReason = GateReason.NONE
    doubt: GateReason = GateReason.NONE
    hold: bool = False


@dataclass(frozen=True)
class LastSent:
    """The offset that the gate let through last; all NaN before the first.

    `offset_*` is what each axis was sent last, of its own capture: of an earlier one than `captured_at_s` if
    the axis was not enabled then. `measured_*` is the offset that was measured then: that which was sent, but
    for a soft start.
    """

    captured_at_s: float = math.nan
    offset_y_mm: float = math.nan
    offset_z_mm: float = math.nan
    confidence: float = math.nan
    captured_y_at_s: float = math.nan
    captured_z_at_s: float = math.nan
    measured_y_mm: float = math.nan
    measured_z_mm: float = math.nan

    def set_back(self, back_s: float) -> "LastSent":
        """Return the same by a clock that was set back, s."""
        return replace(
            self,
            captured_at_s=self.captured_at_s - back_s,
            captured_y_at_s=self.captured_y_at_s - back_s,
            captured_z_at_s=self.captured_z_at_s - back_s,
        )


@dataclass(frozen=True)
class Decision:
    """Decision on a proposal: what goes to the bus, why, and the state for the next one.

    Attributes
    ----------
    verdict : Verdict
        The offset is sent, the last offset is held, or it is refused.
    reason : GateReason
        Reason for which it was not sent, or not as measured.
    message : SeamOffset
        Always to be sent: a refusal, too, must reach the robot.
    last_sent : LastSent
        The state for the next call of `decide`.
    """

    verdict: Verdict
    reason: GateReason
    message: SeamOffset
    last_sent: LastSent = field(default_factory=LastSent)


def decide(
    proposal: Proposal, conditions: Conditions, limits: GateLimits, last_sent: LastSent, now_s: float
) -> Decision:
    """Return the decision on a proposal.

    An axis that is not enabled is neither checked nor sent. Enabled again, it may not jump from the offset
    that it was sent last. Being disarmed forgets the last offset: the first offset after that is zero, and
    each axis approaches the seam from there.

    Parameters
    ----------
    proposal : Proposal
        The offset that wants to go out.
    conditions : Conditions
        The conditions beyond the offset itself.
    limits : GateLimits
        The offset's limits.
    last_sent : LastSent
        The offset that went out last, as the last `Decision` holds it.
    now_s : float
        The time, s, on the clock of the captures.

    Returns
    -------
    Decision
        The message for the bus, and its reason.
    """
    if not conditions.armed:
        last_sent = LastSent()
    forbidden = forbidden_by(conditions, limits)
    if forbidden is not GateReason.NONE:
        return _refuse(forbidden, last_sent)
    reason = _objection(proposal, conditions, limits, last_sent, now_s)
    if reason is GateReason.NONE:
        return _send(proposal, conditions, limits, last_sent, now_s)
    return _hold(reason, conditions, limits, last_sent, now_s)


def forbidden_by(conditions: Conditions, limits: GateLimits) -> GateReason:
    """Return the reason for which no offset may be sent, whatever is measured; NONE if one may."""
    if conditions.fault is not GateReason.NONE:
        return conditions.fault
    reason = _forbidden_by_robot(conditions, limits)
    return conditions.doubt if reason is GateReason.NONE else reason


def _forbidden_by_robot(conditions: Conditions, limits: GateLimits) -> GateReason:
    robot = conditions.robot
    if not conditions.armed:
        return GateReason.NOT_ARMED
    if robot is None:
        return GateReason.ROBOT_STATUS_STALE
    if robot.emergency_stop is not Switch.OFF:
        return GateReason.EMERGENCY_STOP
    if robot.mode not in (RobotMode.AUTOMATIC, RobotMode.DRY_RUN):
        return GateReason.NOT_AUTOMATIC
    if robot.motion is not MotionState.MOVING:
        return GateReason.ROBOT_NOT_MOVING
    if robot.welding is WeldingState.FAULT:
        return GateReason.WELDING_FAULT
    if robot.correction is not Switch.ON:
        return GateReason.CORRECTION_OFF
    if limits.arc_required and robot.arc is not Switch.ON:
        return GateReason.ARC_OFF
    # In a search or a dry run the sequence stands anywhere, but it must be known.
    if robot.welding is WeldingState.UNKNOWN or (
        limits.arc_required and robot.welding is not WeldingState.WELDING
    ):
        return GateReason.NOT_WELDING
    if not (conditions.enable_y or conditions.enable_z):
        return GateReason.NO_AXIS_ENABLED
    return GateReason.NONE


def _objection(
    proposal: Proposal, conditions: Conditions, limits: GateLimits, last_sent: LastSent, now_s: float
) -> GateReason:
    if conditions.hold:
        return GateReason.HOLD_COMMANDED
    axes = _enabled_axes(proposal, conditions, limits, last_sent)
    age_s = now_s - proposal.captured_at_s
    if not all(map(math.isfinite, (age_s, *(axis.offset_mm for axis in axes)))):
        return GateReason.NOT_MEASURED
    if age_s < 0.0:
        return GateReason.CAPTURE_IN_FUTURE
    if age_s > limits.capture_age_s:
        return GateReason.CAPTURE_TOO_OLD
    # Written so that a NaN fails the check.
    if not limits.confidence <= proposal.confidence <= 1.0:
        return GateReason.LOW_CONFIDENCE
    if not all(0.0 <= axis.sigma_mm <= axis.sigma_limit_mm for axis in axes):
        return GateReason.SIGMA_TOO_LARGE
    if any(abs(axis.offset_mm) > axis.range_mm for axis in axes):
        return GateReason.OUT_OF_RANGE
    changes = [(axis, abs(axis.offset_mm - axis.measured_mm)) for axis in axes]
    # An axis that was never sent has changed by NaN, which is beyond no limit.
    if any(change_mm > limits.jump_mm for _, change_mm in changes):
        return GateReason.JUMP
    if any(change_mm > axis.rate_mm_s * min(axis.elapsed_s, limits.hold_s) for axis, change_mm in changes):
        return GateReason.RATE_TOO_HIGH
    return GateReason.NONE


@dataclass(frozen=True)
class _OffsetAxis:
    """One enabled axis of a proposal with its limits.

    `sent_mm`, `measured_mm` and `elapsed_s` are of what the axis was sent last, NaN if it never was.
    """

    offset_mm: float
    sigma_mm: float
    sent_mm: float
    measured_mm: float
    elapsed_s: float
    range_mm: float
    rate_mm_s: float
    sigma_limit_mm: float


def _enabled_axes(
    proposal: Proposal, conditions: Conditions, limits: GateLimits, last_sent: LastSent
) -> list[_OffsetAxis]:
    axes = []
    if conditions.enable_y:
        axes.append(
            _OffsetAxis(
                offset_mm=proposal.offset_y_mm,
                sigma_mm=proposal.sigma_y_mm,
                sent_mm=last_sent.offset_y_mm,
                measured_mm=last_sent.measured_y_mm,
                elapsed_s=proposal.captured_at_s - last_sent.captured_y_at_s,
                range_mm=limits.range_y_mm,
                rate_mm_s=limits.rate_y_mm_s,
                sigma_limit_mm=limits.sigma_y_mm,
            )
        )
    if conditions.enable_z:
        axes.append(
            _OffsetAxis(
                offset_mm=proposal.offset_z_mm,
                sigma_mm=proposal.sigma_z_mm,
                sent_mm=last_sent.offset_z_mm,
                measured_mm=last_sent.measured_z_mm,
                elapsed_s=proposal.captured_at_s - last_sent.captured_z_at_s,
                range_mm=limits.range_z_mm,
                rate_mm_s=limits.rate_z_mm_s,
                sigma_limit_mm=limits.sigma_z_mm,
            )
        )
    return axes


def _send(
    proposal: Proposal, conditions: Conditions, limits: GateLimits, last_sent: LastSent, now_s: float
) -> Decision:
    axes = iter(_enabled_axes(proposal, conditions, limits, last_sent))
    captured_at_s = proposal.captured_at_s
    sent = replace(last_sent, captured_at_s=captured_at_s, confidence=proposal.confidence)
    is_there = True
    if conditions.enable_y:
        offset_mm = _approached(next(axes), limits)
        is_there &= offset_mm == proposal.offset_y_mm
        sent = replace(
            sent, captured_y_at_s=captured_at_s, offset_y_mm=offset_mm, measured_y_mm=proposal.offset_y_mm
        )
    if conditions.enable_z:
        offset_mm = _approached(next(axes), limits)
        is_there &= offset_mm == proposal.offset_z_mm
        sent = replace(
            sent, captured_z_at_s=captured_at_s, offset_z_mm=offset_mm, measured_z_mm=proposal.offset_z_mm
        )
    reason = GateReason.NONE
    if not is_there:
        # Where the robot is sent is not where the seam is.
        sent, reason = replace(sent, confidence=0.0), GateReason.SOFT_START
    return Decision(Verdict.SEND, reason, _message(sent, conditions, Validity.VALID, now_s), sent)


def _approached(axis: _OffsetAxis, limits: GateLimits) -> float:
    """Return the measured offset, or the nearest to it that the rate limit allows from what was sent last.

    An axis that was sent nothing yet is at zero, where the robot is armed.
    """
    sent_mm, elapsed_s = axis.sent_mm, axis.elapsed_s
    if math.isnan(sent_mm):
        sent_mm = elapsed_s = 0.0
    step_mm = min(axis.rate_mm_s * min(elapsed_s, limits.hold_s), limits.jump_mm)
    way_mm = axis.offset_mm - sent_mm
    return axis.offset_mm if abs(way_mm) <= step_mm else sent_mm + math.copysign(step_mm, way_mm)


def _hold(
    reason: GateReason, conditions: Conditions, limits: GateLimits, last_sent: LastSent, now_s: float
) -> Decision:
    held = _message(last_sent, conditions, Validity.HELD, now_s)
    nothing_to_hold = math.isnan(held.offset_y_mm) and math.isnan(held.offset_z_mm)
    if nothing_to_hold or not 0.0 <= now_s - last_sent.captured_at_s <= limits.hold_s:
        return _refuse(reason, last_sent)
    return Decision(Verdict.HOLD, reason, held, last_sent)


def _refuse(reason: GateReason, last_sent: LastSent) -> Decision:
    message = SeamOffset(math.nan, math.nan, math.nan, math.nan, Validity.REFUSED)
    return Decision(Verdict.REFUSE, reason, message, last_sent)


def _message(sent: LastSent, conditions: Conditions, validity: Validity, now_s: float) -> SeamOffset:
    """Return the message of what was sent last; an axis that is off, or was then, is unknown."""
    has_y = conditions.enable_y and sent.captured_y_at_s == sent.captured_at_s
    has_z = conditions.enable_z and sent.captured_z_at_s == sent.captured_at_s
    return out_of_range_as_unknown(
        SeamOffset(
            offset_y_mm=sent.offset_y_mm if has_y else math.nan,
            offset_z_mm=sent.offset_z_mm if has_z else math.nan,
            capture_age_ms=1000.0 * (now_s - sent.captured_at_s),
            confidence=sent.confidence,
            validity=validity,
        )
    )
