"""Result of a check of the machine."""

from dataclasses import dataclass
from enum import Enum


class FindingState(Enum):
    """State of a finding; a live run is impossible with one that failed."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"


@dataclass(frozen=True)
class DoctorFinding:
    """Result of one check: what was seen on one line, and the cure, empty where it is ok."""

    name: str
    state: FindingState
    text: str
    cure: str = ""

    def __str__(self) -> str:
        return f"{self.name}: {self.text}" + (f"; {self.cure}" if self.cure else "")


def judged(name: str, text: str, problem: FindingState, cure: str, is_good: bool) -> DoctorFinding:
    """Return a finding that is ok, or else the problem with its cure."""
    return DoctorFinding(name, FindingState.OK, text) if is_good else DoctorFinding(name, problem, text, cure)
