"""The limits of the checks: each with its unit, its role, its source and what hangs on it."""

from dataclasses import dataclass, field


def _limit(value: float, unit: str, role: str, source: str, sensitivity: str) -> float:
    metadata = {"unit": unit, "role": role, "source": source, "sensitivity": sensitivity}
    limit: float = field(default=value, metadata=metadata)
    return limit


@dataclass(frozen=True)
class DoctorPolicy:
    """Thresholds of the checks; each field's metadata states unit, role, source and sensitivity."""

    clock_step_s: float = _limit(
        1e-5,
        "s",
        "largest step of the clock",
        "a hundredth of what the bus rounds ages to",
        "none below 1 ms",
    )
    wake_up_s: float = _limit(
        0.002, "s", "sleep that is timed", "a turn of the loop waits as long", "longer ones are as late"
    )
    wake_ups: int = 450
    work_s: float = _limit(
        0.5, "s", "work that is timed", "a hundred time slices of the scheduler, of some ms", "none beyond"
    )
    wait_share: float = _limit(
        0.25,
        "",
        "largest share of the time that work waits",
        "one other process that works all the time takes 0.5 of a processor, none takes 0",
        "halfway between the two",
    )
    listen_s: float = _limit(
        1.0,
        "s",
        "wait for robot and camera",
        "the slowest message comes each second",
        "a slow camera needs more",
    )
    disk_free_bytes: float = _limit(
        1e9,
        "bytes",
        "least room on a disk",
        "30 s of 1 MB frames at 25 Hz, compressed",
        "the recordings' size",
    )
    ethernet_payload_bytes_s: float = _limit(
        119e6,
        "bytes/s",
        "payload of gigabit Ethernet",
        "125 MB/s less headers at 9000 bytes a packet, and a share for commands",
        "the rows of an image, in proportion",
    )
    steps: int = 240


POLICY = DoctorPolicy()
