"""Result of a check of the machine, and the limits of the checks."""

from dataclasses import dataclass
from enum import Enum

from robot_io.stated_limit import stated


@dataclass(frozen=True)
class DoctorPolicy:
    """Thresholds of the checks; each field's metadata states unit, role, source and sensitivity."""

    clock_step_s: float = stated(
        1e-5,
        "s",
        "largest step of the clock",
        "a hundredth of what the bus rounds ages to",
        "none below 1 ms",
    )
    wake_up_s: float = stated(
        0.002, "s", "sleep that is timed", "a turn of the loop waits as long", "longer ones are as late"
    )
    wake_ups: int = 450
    work_s: float = stated(
        0.5, "s", "work that is timed", "a hundred time slices of the scheduler, of some ms", "none beyond"
    )
    wait_share: float = stated(
        0.25,
        "",
        "largest share of the time that work waits",
        "one other process that works all the time takes 0.5 of a processor, none takes 0",
        "halfway between the two",
    )
    listen_s: float = stated(
        1.0,
        "s",
        "wait for robot and camera",
        "the slowest message comes each second",
        "a slow camera needs more",
    )
    disk_free_bytes: float = stated(
        1e9,
        "bytes",
        "least room on a disk",
        "30 s of 1 MB frames at 25 Hz, compressed",
        "the recordings' size",
    )
    ethernet_payload_bytes_s: float = stated(
        119e6,
        "bytes/s",
        "payload of gigabit Ethernet",
        "125 MB/s less headers at 9000 bytes a packet, and a share for commands",
        "the rows of an image, in proportion",
    )
    steps: int = 240


POLICY = DoctorPolicy()


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
