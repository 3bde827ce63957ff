"""Versions, scheduler, memory and disk of the machine."""

import os
import platform
import shutil
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from arctrack.control.cell_file import ProcessChoice
from arctrack.live.doctor.finding import POLICY, DoctorFinding, FindingState, judged
from arctrack.live.journal.private_memory import memory_folder
from arctrack.system import choose_priority, max_locked_bytes, max_priority, processors, scheduling_kept

PACKAGES = ("arctrack", "numpy", "numba", "opencv-contrib-python-headless", "python-can", "av", "aiohttp")
PROCESSORS = Path("/sys/devices/system/cpu")
STATUS = Path("/proc/self/status")
RECEIVE_LIMIT = Path("/proc/sys/net/core/rmem_max")
LIMITS_CURE = "give the user {key} in /etc/security/limits.conf and log in anew"
CAP_IPC_LOCK = 14


def versions_finding() -> DoctorFinding:
    """Return which versions there are."""
    parts = [f"Python {platform.python_version()}"]
    for name in PACKAGES:
        try:
            parts.append(f"{name.removesuffix('-contrib-python-headless')} {version(name)}")
        except PackageNotFoundError:
            parts.append(f"{name} not installed")
    return DoctorFinding("versions", FindingState.OK, ", ".join(parts))


def scheduler_findings(choice: ProcessChoice) -> Iterator[DoctorFinding]:
    """Yield the findings about kernel, processors and real-time priority."""
    kind = "PREEMPT_RT" if "PREEMPT_RT" in platform.version() else "not PREEMPT_RT: see how late it wakes up"
    yield DoctorFinding("kernel", FindingState.OK, f"{platform.release()}, {kind}")
    try:
        isolated = (PROCESSORS / "isolated").read_text(encoding="ascii").strip()
    except OSError:
        isolated = ""
    held = f"{isolated} isolated from other work" if isolated else "none isolated from other work"
    yield DoctorFinding("processors", FindingState.OK, f"{os.cpu_count()}, {held}")
    governors = sorted(
        {path.read_text().strip() for path in PROCESSORS.glob("cpu*/cpufreq/scaling_governor")}
    )
    yield governor_finding(governors)
    yield _priority_finding(choice)
    if choice.cpus is not None:
        there = processors()
        yield judged(
            "[process] cpus",
            f"{list(choice.cpus)} of {there}",
            FindingState.FAILED,
            "choose of those that this process may use",
            set(choice.cpus) <= set(there),
        )


def governor_finding(governors: list[str]) -> DoctorFinding:
    """Return the finding about the governor of the processors' frequency."""
    if not governors:
        return DoctorFinding("frequency", FindingState.OK, "not governed by this kernel")
    return judged(
        "frequency",
        f"governor {', '.join(governors)}",
        FindingState.WARNING,
        "a slow clock makes steps late; cpupower frequency-set --governor performance",
        governors == ["performance"],
    )


def _priority_finding(choice: ProcessChoice) -> DoctorFinding:
    wanted = choice.priority or 1
    try:
        with scheduling_kept():
            choose_priority(wanted)
    except OSError as error:
        problem = FindingState.WARNING if choice.priority is None else FindingState.FAILED
        text = f"SCHED_FIFO {wanted}: {error.strerror}, RLIMIT_RTPRIO {max_priority()}"
        return DoctorFinding("real-time priority", problem, text, LIMITS_CURE.format(key="an rtprio"))
    asked = "" if choice.priority else "; [process] priority asks for none"
    return DoctorFinding("real-time priority", FindingState.OK, f"SCHED_FIFO {wanted} is allowed{asked}")


def memory_lock_finding(
    limit_bytes: int | None, may_exceed: bool, needed_bytes: int, is_asked: bool
) -> DoctorFinding:
    """Find whether the memory that a run maps may be locked.

    `limit_bytes` is RLIMIT_MEMLOCK, None for no limit; CAP_IPC_LOCK (`may_exceed`) lifts it.
    `needed_bytes` is all that a run maps: mlockall counts it, used or not. `is_asked` says that the cell asks
    for locking.
    """
    if may_exceed or limit_bytes is None:
        limit, is_enough = "unlimited", True
    else:
        limit, is_enough = f"{limit_bytes / 1e6:.1f} MB", limit_bytes >= needed_bytes
    return judged(
        "memory lock",
        f"{limit} may be locked, a run maps {needed_bytes / 1e6:.0f} MB",
        FindingState.FAILED if is_asked else FindingState.WARNING,
        LIMITS_CURE.format(key="memlock unlimited") + ("" if is_asked else ", before you state lock_memory"),
        is_enough,
    )


def own_memory_lock_finding(more_bytes: int, is_asked: bool) -> DoctorFinding:
    """Return whether what this process maps, and some more, may be locked into memory."""
    status = dict(line.split(":", 1) for line in STATUS.read_text(encoding="utf-8").splitlines())
    mapped_bytes = 1024 * int(status["VmSize"].split()[0])
    may_exceed = bool(int(status["CapEff"], 16) >> CAP_IPC_LOCK & 1)
    return memory_lock_finding(max_locked_bytes(), may_exceed, mapped_bytes + more_bytes, is_asked)


def receive_buffer_finding(limit_bytes: int, image_bytes: int) -> DoctorFinding:
    """Return whether the kernel may hold an image that comes over Ethernet while its reader waits."""
    return judged(
        "receive buffer",
        f"net.core.rmem_max {limit_bytes} bytes, an image has {image_bytes}",
        FindingState.WARNING,
        f"packets are lost while its reader waits; sysctl net.core.rmem_max={max(2 * image_bytes, 2**24)}",
        limit_bytes >= image_bytes,
    )


def own_receive_buffer_finding(image_bytes: int) -> DoctorFinding:
    """Return the same for this machine's limit."""
    return receive_buffer_finding(int(RECEIVE_LIMIT.read_text(encoding="ascii")), image_bytes)


def shared_memory_finding(needed_bytes: int) -> DoctorFinding:
    """Return whether the rings of a run have room in shared memory."""
    folder = memory_folder()
    free_bytes = shutil.disk_usage(folder).free
    return judged(
        "shared memory",
        f"{folder}: {free_bytes / 1e6:.0f} MB free, a run takes {needed_bytes / 1e6:.0f} MB",
        FindingState.FAILED,
        f"choose fewer [black_box] seconds, or mount -o remount,size=… {folder}",
        free_bytes >= needed_bytes,
    )


def disk_finding(folder: Path) -> DoctorFinding:
    """Return whether there is room for recordings on a disk."""
    while not folder.exists():
        folder = folder.parent
    free_bytes = shutil.disk_usage(folder).free
    return judged(
        "disk",
        f"{folder}: {free_bytes / 1e9:.1f} GB free",
        FindingState.WARNING,
        "recordings and logs need room; remove old ones, or choose another folder",
        free_bytes >= POLICY.disk_free_bytes,
    )
