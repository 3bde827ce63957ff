"""The last word before the bus: whether an offset is sent, the last one held, or the correction refused.

A refusal says that nothing may be corrected at all (not armed, emergency stop, no arc …). A hold says that
this one capture is no good: the offset sent last is repeated, until its own capture is older than `hold_s`;
then the hold becomes a refusal with the same reason. Values are never changed on the way: an offset goes
through as it is or not at all. All limits are inclusive: a value at its limit passes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from enum import Enum

from robot_io.codec import out_of_range_as_unknown
from robot_io.messages import GateReason, RobotMode, RobotStatus, SeamOffset, Switch, Validity

BUS_RANGE_MM = 32.767
"""The largest offset that the bus can carry, mm."""


class Verdict(Enum):
    """What becomes of a proposal."""

    SEND = "send"
    HOLD = "hold"
    REFUSE = "refuse"


@dataclass(frozen=True)
class GateLimits:
    """What an offset must keep to.

    Parameters
    ----------
    range_y_mm, range_z_mm : float
        The largest offset, mm.
    rate_y_mm_s, rate_z_mm_s : float
        The largest change between two captures, mm/s, counted over at most `hold_s`. A seam that jumps
        further than `rate · hold_s` is never followed before the tracker is armed anew.
    capture_age_s : float
        The largest age of the capture, s.
    confidence : float
        The least confidence, 0 to 1.
    hold_s : float
        How long the last offset is held while none passes, s.
    sigma_y_mm, sigma_z_mm : float
        The largest sigma, mm; infinite switches this check off.
    arc_required : bool
        Whether the robot must report that the arc is on.

    Raises
    ------
    ValueError
        For a limit that is not positive and finite, or that the bus cannot carry.
    """

    range_y_mm: float
    range_z_mm: float
    rate_y_mm_s: float
    rate_z_mm_s: float
    capture_age_s: float
    confidence: float
    hold_s: float
    sigma_y_mm: float = math.inf
    sigma_z_mm: float = math.inf
    arc_required: bool = True

    def __post_init__(self) -> None:
        for limit in (f.name for f in fields(self) if f.name != "arc_required"):
            value = getattr(self, limit)
            if not value > 0.0 or (math.isinf(value) and not limit.startswith("sigma")):
                raise ValueError(f"gate limit {limit}: is {value}; it must be positive and finite")
        for limit in ("range_y_mm", "range_z_mm"):
            if getattr(self, limit) > BUS_RANGE_MM:
                raise ValueError(f"gate limit {limit}: above {BUS_RANGE_MM} mm, which the bus cannot carry")
        if self.confidence > 1.0:
            raise ValueError(f"gate limit confidence: is {self.confidence}; it is a probability, at most 1")


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
    """What must hold beside the offset.

    Parameters
    ----------
    armed : bool
        Whether the tracker may send offsets.
    enable_y, enable_z : bool
        Which axes are corrected.
    robot : RobotStatus or None
        The robot's last status; None while no fresh status has been received.
    """

    armed: bool
    enable_y: bool
    enable_z: bool
    robot: RobotStatus | None


@dataclass(frozen=True)
class LastSent:
    """The offset that the gate let through last; all NaN before the first.

    `offset_*` is what each axis was sent last, of its own capture: of an earlier one than `captured_at_s` if
    the axis was not enabled then.
    """

    captured_at_s: float = math.nan
    offset_y_mm: float = math.nan
    offset_z_mm: float = math.nan
    confidence: float = math.nan
    captured_y_at_s: float = math.nan
    captured_z_at_s: float = math.nan


@dataclass(frozen=True)
class Decision:
    """What goes to the bus, why, and what the gate must be given the next time.

    Attributes
    ----------
    verdict : Verdict
        The offset is sent, the last offset is held, or it is refused.
    reason : GateReason
        Why it was not sent.
    message : SeamOffset
        Always to be sent: a refusal, too, must reach the robot.
    last_sent : LastSent
        What the next call of `decide` is given.
    """

    verdict: Verdict
    reason: GateReason
    message: SeamOffset
    last_sent: LastSent = field(default_factory=LastSent)


def decide(
    proposal: Proposal, conditions: Conditions, limits: GateLimits, last_sent: LastSent, now_s: float
) -> Decision:
    """Return what becomes of a proposal.

    An axis that is not enabled is neither checked nor sent. Enabled again, it may not jump from the offset
    that it was sent last. Being disarmed forgets the last offset, so the first offset after that is free of
    the rate limit.

    Parameters
    ----------
    proposal : Proposal
        The offset that wants to go out.
    conditions : Conditions
        What must hold beside the offset.
    limits : GateLimits
        What the offset must keep to.
    last_sent : LastSent
        The offset that went out last, as the last `Decision` holds it.
    now_s : float
        The time, s, on the clock of the captures.

    Returns
    -------
    Decision
        What goes to the bus, and why.
    """
    if not conditions.armed:
        last_sent = LastSent()
    forbidden = _forbidden(conditions, limits)
    if forbidden is not GateReason.NONE:
        return _refuse(forbidden, last_sent)
    reason = _objection(proposal, conditions, limits, last_sent, now_s)
    if reason is GateReason.NONE:
        return _send(proposal, conditions, last_sent, now_s)
    return _hold(reason, conditions, limits, last_sent, now_s)


def _forbidden(conditions: Conditions, limits: GateLimits) -> GateReason:
    robot = conditions.robot
    if not conditions.armed:
        return GateReason.NOT_ARMED
    if robot is None:
        return GateReason.ROBOT_STATUS_STALE
    if robot.emergency_stop is not Switch.OFF:
        return GateReason.EMERGENCY_STOP
    if robot.mode not in (RobotMode.AUTOMATIC, RobotMode.DRY_RUN):
        return GateReason.NOT_AUTOMATIC
    if robot.correction is not Switch.ON:
        return GateReason.CORRECTION_OFF
    if limits.arc_required and robot.arc is not Switch.ON:
        return GateReason.ARC_OFF
    if not (conditions.enable_y or conditions.enable_z):
        return GateReason.NO_AXIS_ENABLED
    return GateReason.NONE


def _objection(
    proposal: Proposal, conditions: Conditions, limits: GateLimits, last_sent: LastSent, now_s: float
) -> GateReason:
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
    sent_before = (axis for axis in axes if not math.isnan(axis.change_mm))
    if any(axis.change_mm > axis.rate_mm_s * min(axis.elapsed_s, limits.hold_s) for axis in sent_before):
        return GateReason.RATE_TOO_HIGH
    return GateReason.NONE


@dataclass(frozen=True)
class _Axis:
    """One enabled axis of a proposal beside its limits.

    `change_mm` and `elapsed_s` are since the axis was sent last, NaN if it never was.
    """

    offset_mm: float
    sigma_mm: float
    change_mm: float
    elapsed_s: float
    range_mm: float
    rate_mm_s: float
    sigma_limit_mm: float


def _enabled_axes(
    proposal: Proposal, conditions: Conditions, limits: GateLimits, last_sent: LastSent
) -> list[_Axis]:
    axes = []
    if conditions.enable_y:
        axes.append(
            _Axis(
                proposal.offset_y_mm,
                proposal.sigma_y_mm,
                abs(proposal.offset_y_mm - last_sent.offset_y_mm),
                proposal.captured_at_s - last_sent.captured_y_at_s,
                limits.range_y_mm,
                limits.rate_y_mm_s,
                limits.sigma_y_mm,
            )
        )
    if conditions.enable_z:
        axes.append(
            _Axis(
                proposal.offset_z_mm,
                proposal.sigma_z_mm,
                abs(proposal.offset_z_mm - last_sent.offset_z_mm),
                proposal.captured_at_s - last_sent.captured_z_at_s,
                limits.range_z_mm,
                limits.rate_z_mm_s,
                limits.sigma_z_mm,
            )
        )
    return axes


def _send(proposal: Proposal, conditions: Conditions, last_sent: LastSent, now_s: float) -> Decision:
    sent = replace(last_sent, captured_at_s=proposal.captured_at_s, confidence=proposal.confidence)
    if conditions.enable_y:
        sent = replace(sent, captured_y_at_s=proposal.captured_at_s, offset_y_mm=proposal.offset_y_mm)
    if conditions.enable_z:
        sent = replace(sent, captured_z_at_s=proposal.captured_at_s, offset_z_mm=proposal.offset_z_mm)
    return Decision(Verdict.SEND, GateReason.NONE, _message(sent, conditions, Validity.VALID, now_s), sent)


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
