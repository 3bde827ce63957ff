"""Number of offsets sent, of those that the robot wanted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from robot_io import GateReason

COMMANDED = frozenset(
    {
        GateReason.NONE,
        GateReason.NOT_ARMED,
        GateReason.EMERGENCY_STOP,
        GateReason.NOT_AUTOMATIC,
        GateReason.CORRECTION_OFF,
        GateReason.ARC_OFF,
        GateReason.NO_AXIS_ENABLED,
        GateReason.ROBOT_NOT_MOVING,
        GateReason.NOT_WELDING,
        GateReason.SEARCH_ONLY,
        GateReason.SHUTTING_DOWN,
    }
)
"""Reasons for a refusal that the robot's program or a person gives: no fault."""


@dataclass(frozen=True)
class OffsetCount:
    """Offsets that went out as measured, of those that the robot wanted.

    It wants none while it is not armed, its arc is off, and the like.
    """

    sent: int
    wanted: int

    @classmethod
    def of(cls, sent: int, offsets: int, reasons: Mapping[str, int]) -> OffsetCount:
        """Count offsets by how many were sent, and by the gate's reasons for the others."""
        return cls(sent, offsets - sum(reasons.values()) + sum(faults(reasons).values()))

    @property
    def none_sent(self) -> bool:
        """True if offsets were wanted and none went out."""
        return self.wanted > 0 and self.sent == 0

    def __str__(self) -> str:
        return f"{self.sent} of {self.wanted} offsets sent" if self.wanted else "no offset was wanted"


def faults(reasons: Mapping[str, int]) -> dict[str, int]:
    """Return the gate's reasons, by name, without those that the robot's program or a person gives."""
    commanded = {reason.name for reason in COMMANDED}
    return {name: count for name, count in reasons.items() if name.upper() not in commanded}
