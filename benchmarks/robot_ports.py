"""How long a packet takes through each robot's port, beside CAN, and how well a torch is led over it.

The robots are those of the tests, written from the vendors' layouts. Each port runs as its own process; robot
and tracker are this one. CAN is python-can's udp_multicast, in the same run. Needs a clone.

    python benchmarks/robot_ports.py
"""

from __future__ import annotations

import argparse
import math
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests" / "robot_io" / "ports"))

from port_cell import port_cell
from vendor_robots import ROBOTS, Said, UrRobot

from arctrack.control.cell_file import BusChoice, ProcessChoice
from arctrack.control.robot_messages import TRUSTED
from arctrack.live.serve.robot_port import port_process
from robot_io import (
    ANY_SOURCE,
    Link,
    LinkError,
    PoseKind,
    RobotPosePosition,
    RobotPoseRotation,
    SeamOffset,
    Source,
    Validity,
)
from validation.fault_schedules.judged_cell import JudgedCell
from validation.fault_schedules.worlds import draw_world

GROUP = "239.74.163.2"
PACKETS_S = 0.02
"""Time between packets: each kind of message is due then."""


def time_received_s(link: Link, kind: type) -> float:
    """Return when a message of a kind comes, s; NaN where it was lost, or dropped for its age."""
    for each in link.receive(0.2):
        if isinstance(each.message, kind):
            return time.perf_counter()
    return math.nan


def timed(packets: int, packet: Callable[[], tuple[float, float]]) -> tuple[float, float]:
    """Return the medians of ways in and out, ms."""
    ways = []
    for _ in range(packets):
        ways.append(packet())
        time.sleep(PACKETS_S)
    inward_s, outward_s = np.nanmedian(ways[packets // 5 :], axis=0)
    return 1e3 * inward_s, 1e3 * outward_s


def can_ways(packets: int) -> tuple[float, float]:
    """Return the ways of a pose to the tracker and of an offset to the robot, ms."""
    options = {"trusted": ANY_SOURCE, "port": 43_113, "hop_limit": 0}
    with (
        Link("udp_multicast", GROUP, **options) as tracker,
        Link("udp_multicast", GROUP, source=Source.SIMULATION, **options) as robot,
    ):

        def packet() -> tuple[float, float]:
            sent_s = time.perf_counter()
            robot.send(RobotPosePosition(1.0, 2.0, 3.0, PoseKind.ACTUAL))
            robot.send(RobotPoseRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), 2.0))
            came_s = time_received_s(tracker, RobotPoseRotation)
            given_s = time.perf_counter()
            tracker.send(SeamOffset(0.1, 0.2, 30.0, 0.9, Validity.VALID))
            return came_s - sent_s, time_received_s(robot, SeamOffset) - given_s

        return timed(packets, packet)


def connected_robot(interface: str, number: int) -> tuple[object, socket.socket]:
    """Return a vendor's robot and its socket, before anything is said."""
    address = ("127.0.0.1", number)
    if interface in ("egm", "rsi"):
        stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        stream.connect(address)
    else:
        stream = socket.create_connection(address)
    stream.settimeout(5.0)
    return ROBOTS[interface](), stream


def port_ways(interface: str, packets: int) -> tuple[float, float]:
    """Return the ways of a report to the tracker and of its answer to the robot, ms; EGM's answer is none."""
    server = socket.create_server(("127.0.0.1", 0))
    number = server.getsockname()[1]
    if interface != "rtde":
        server.close()
    bus = BusChoice(interface, f"127.0.0.1:{number}", 500_000)
    process, open_bus = port_process(bus, ProcessChoice())
    process.wait_ready()
    try:
        with Link(interface, bus.channel, trusted=TRUSTED, open_bus=open_bus) as link:
            if interface == "rtde":
                robot, (stream, _) = UrRobot(), server.accept()
                stream.settimeout(5.0)
                while not robot.started:
                    stream.sendall(robot.hear(stream.recv(4096))[0])
            else:
                robot, stream = connected_robot(interface, number)
            if interface == "tcp_json":
                stream.sendall(robot.hello)
                stream.recv(4096)
            began_s = time.monotonic()

            def packet() -> tuple[float, float]:
                said = Said(time_s=round(time.monotonic() - began_s + 1.0, 3))
                data = robot.report(said)
                sent_s = time.perf_counter()
                stream.sendall(data)
                if interface != "egm":
                    stream.recv(4096)
                answered_s = time.perf_counter()
                return time_received_s(link, RobotPoseRotation) - sent_s, answered_s - sent_s

            with stream:
                return timed(packets, packet)
    finally:
        process.end()
        server.close()


def led(interface: str, seconds: float) -> tuple[float, float]:
    """Return the torch's error, rms mm, and the estimated lag, ms, in a simulated cell."""
    rng = np.random.default_rng(1)
    world = draw_world(rng)
    cell = JudgedCell(world, rng) if interface == "can" else port_cell(world, rng, interface)
    cell.run(seconds)
    off_mm = [off_mm for time_s, off_mm in cell.torch_error_mm if time_s > 3.0]
    return float(np.sqrt(np.mean(np.square(off_mm)))), 1e3 * cell.tracker.poses.look_ahead.lag.lag_s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--packets", type=int, default=500)
    parser.add_argument("--seconds", type=float, default=20.0, help="of the simulated cell")
    arguments = parser.parse_args()
    try:
        can_in_ms, can_out_ms = can_ways(arguments.packets)
    except LinkError as error:
        parser.error(str(error))
    print("| robot | report to tracker | over CAN's | answer to robot | torch's error | lag |")
    print("| --- | --- | --- | --- | --- | --- |")
    for interface in ("can", *ROBOTS):
        in_ms, out_ms = (
            (can_in_ms, can_out_ms) if interface == "can" else port_ways(interface, arguments.packets)
        )
        rms_mm, lag_ms = led(interface, arguments.seconds)
        answer = "none before an offset" if interface == "egm" else f"{out_ms:.2f} ms"
        print(
            f"| {interface} | {in_ms:.2f} ms | {in_ms / can_in_ms:.2f} | {answer} | {rms_mm:.4f} mm rms "
            f"| {lag_ms:.0f} ms |"
        )


if __name__ == "__main__":
    main()
