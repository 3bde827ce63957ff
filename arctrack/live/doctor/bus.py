"""Checks of the bus: whether it opens, its state, and whether a robot sends."""

import json
import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from arctrack.control.cell_file import BusChoice, CellFile
from arctrack.control.cell_file.choices import HIGH_LOAD
from arctrack.control.robot_messages import TRUSTED
from arctrack.errors import ArctrackError
from arctrack.live.doctor.finding import POLICY, DoctorFinding, FindingState, judged
from arctrack.live.serve.robot_port import port_process
from robot_io import Link, LinkError

ROBOT_CURE = "check the bit rate, the terminators and whether the robot's controller runs"
PORT_CURE = "check the cable, the addresses and whether the robot's program runs"


def bus_findings(cell: CellFile, **bus_options: Any) -> Iterator[DoctorFinding]:
    """Yield the findings about a cell's bus; nothing is sent. `bus_options` go to python-can."""
    bus = cell.bus
    if bus.is_port:
        yield from _robot_port_findings(cell)
        return
    yield judged(
        "bus load",
        f"{100.0 * cell.bus_load:.0f} % of {bus.bit_rate_bit_s / 1000.0:g} kbit/s at most",
        FindingState.WARNING,
        "what is last may wait; choose a higher bit rate, or fewer frames a second",
        cell.bus_load <= HIGH_LOAD,
    )
    if bus.interface == "virtual":
        cure = "state the robot's bus in [bus] before you weld"
        yield DoctorFinding("bus", FindingState.WARNING, f"{bus} goes to nobody", cure)
        return
    if bus.interface == "socketcan":
        yield from _socketcan_findings(bus)
    elif bus.interface == "slcan":
        yield _port_finding(Path(bus.channel))
    try:
        link = Link(
            bus.interface, bus.channel, bitrate_bit_s=bus.bit_rate_bit_s, trusted=TRUSTED, **bus_options
        )
    except LinkError as error:
        yield DoctorFinding("bus", FindingState.FAILED, str(error))
        return
    yield from _link_findings(bus, link, ROBOT_CURE)


def _robot_port_findings(cell: CellFile) -> Iterator[DoctorFinding]:
    """Yield whether a robot's port opens, and what its robot says."""
    bus = cell.bus
    process, open_bus = port_process(bus, cell.process)
    try:
        process.wait_ready()
        link = Link(bus.interface, bus.channel, trusted=TRUSTED, open_bus=open_bus)
        yield from _link_findings(bus, link, PORT_CURE)
        for problem in process.look():
            yield DoctorFinding("port", FindingState.WARNING, problem, PORT_CURE)
    except ArctrackError as error:
        yield DoctorFinding("bus", FindingState.FAILED, str(error))
    finally:
        process.end()


def _link_findings(bus: BusChoice, link: Link, cure: str) -> Iterator[DoctorFinding]:
    with link:
        yield DoctorFinding("bus", FindingState.OK, f"{bus} opens")
        counts: Counter[str] = Counter()
        ends_s = time.monotonic() + POLICY.listen_s
        while time.monotonic() < ends_s:
            for received in link.receive(0.0):
                counts[type(received.message).__name__] += 1
            time.sleep(POLICY.wake_up_s)
        yield robot_finding(counts, {reason.value: n for reason, n in link.inbox.skipped.items()}, cure)


def robot_finding(counts: dict[str, int], skipped: dict[str, int], cure: str = ROBOT_CURE) -> DoctorFinding:
    """Return the finding about counts of messages by name, and of other frames by reason."""
    refused = ", ".join(f"{reason} {count}" for reason, count in sorted(skipped.items()))
    if not counts:
        other = f"frames that are no messages: {refused}" if refused else "nothing"
        return DoctorFinding("robot", FindingState.WARNING, f"heard {other} in {POLICY.listen_s:g} s", cure)
    names = ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
    return DoctorFinding("robot", FindingState.OK, f"in {POLICY.listen_s:g} s {names}")


def _port_finding(port: Path) -> DoctorFinding:
    if not port.exists():
        return DoctorFinding(
            "serial port", FindingState.FAILED, f"{port} is not there", "plug the adapter in"
        )
    return DoctorFinding("serial port", FindingState.OK, f"{port} is there")


def _socketcan_findings(bus: BusChoice) -> Iterator[DoctorFinding]:
    program = shutil.which("ip")
    if program is None:
        yield DoctorFinding("interface", FindingState.WARNING, "its state is not told", "install iproute2")
        return
    shown = subprocess.run(
        [program, "-details", "-json", "link", "show", bus.channel],
        capture_output=True,
        text=True,
        check=False,
    )
    if shown.returncode != 0:
        cure = f"ip link set {bus.channel} up type can bitrate {bus.bit_rate_bit_s}"
        yield DoctorFinding(
            "interface", FindingState.FAILED, f"{bus.channel} is not there", f"load its driver, then {cure}"
        )
        return
    yield from interface_findings(json.loads(shown.stdout)[0], bus)


def interface_findings(link: dict[str, Any], bus: BusChoice) -> Iterator[DoctorFinding]:
    """Yield the findings about a CAN interface; `link` is the output of `ip -details -json link show`."""
    up = f"ip link set {bus.channel} up type can bitrate {bus.bit_rate_bit_s} restart-ms 100"
    anew = f"ip link set {bus.channel} down && {up}"
    yield judged(
        "interface", f"{bus.channel} {_up_or_down(link)}", FindingState.FAILED, up, "UP" in link["flags"]
    )
    info = link.get("linkinfo", {})
    controller = info.get("info_data", {})
    if info.get("info_kind") != "can":
        kind = info.get("info_kind", "not a CAN interface")
        yield DoctorFinding(
            "bit rate", FindingState.WARNING, f"{kind}: has none", "a robot is on a real controller"
        )
        return
    bit_rate = controller.get("bittiming", {}).get("bitrate")
    yield judged(
        "bit rate",
        f"{bit_rate} bit/s, the cell file states {bus.bit_rate_bit_s}",
        FindingState.FAILED,
        anew,
        bit_rate == bus.bit_rate_bit_s,
    )
    state = controller.get("state", "not told")
    is_dead = state in ("BUS-OFF", "STOPPED")
    problem = FindingState.FAILED if is_dead else FindingState.WARNING
    cure = anew if is_dead else ROBOT_CURE
    yield judged("controller", state, problem, cure, state == "ERROR-ACTIVE")
    restart_ms = controller.get("restart_ms", 0)
    yield judged(
        "restart", f"{restart_ms} ms after bus-off, 0 for never", FindingState.WARNING, anew, restart_ms > 0
    )


def _up_or_down(link: dict[str, Any]) -> str:
    return "is up" if "UP" in link["flags"] else "is down"
