"""The closed loop over a port: `arctrack serve`, a rendered camera, and a robot that speaks JSON over TCP."""

from __future__ import annotations

import json
import math
import os
import select
import socket
import subprocess
import sys
import time
from pathlib import Path

import can
import numpy as np
import pytest
from made import replace_in

from arctrack.child_process import ChildProcess
from arctrack.live.serve.simulated import write_simulated_cell
from arctrack.live.simulated_cell import run_camera, run_robot
from arctrack.simulation.cell.cell import TORCH_MM
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.weld.closed_loop import LoopPlan
from robot_io import (
    BusMessage,
    CommandHeard,
    Fault,
    Inbox,
    LaserState,
    PoseAssembler,
    Protector,
    RequestResult,
    RobotStatus,
    SeamOffset,
    Source,
    TrackerCommand,
    TrackerHeartbeat,
    TrackerState,
    Validity,
)

PLAN = LoopPlan(joint="lap", length_mm=1000.0, rate_hz=10.0, size_px=(160, 120))
SERVE = "import sys; from arctrack.cli import main; sys.argv[1:1] = ['serve']; main()"


class JsonBus(can.BusABC):
    """What the simulated robot takes for its bus: its poses go out as reports, answers come in as frames."""

    def __init__(self, port: int) -> None:
        super().__init__(channel="json")
        self._address = ("127.0.0.1", port)
        self._stream: socket.socket | None = None
        self._inbox, self._assembler, self._protector = Inbox(), PoseAssembler(), Protector()
        self._status: RobotStatus | None = None
        self._command: TrackerCommand | None = None
        self._seq = self._rolling = 0
        self._rest, self._frames = b"", []
        self.usable = 0

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        msg.timestamp = time.monotonic()
        received = self._inbox.receive(msg)
        if isinstance(received.message, RobotStatus):
            self._status = received.message
        elif isinstance(received.message, TrackerCommand):
            self._command = received.message
        pose = self._assembler.push(received)
        if pose is not None and self._status is not None and self._command is not None:
            self._report(pose, self._status, self._command)

    def shutdown(self) -> None:
        super().shutdown()
        if self._stream is not None:
            self._stream.close()

    def _report(self, pose, status: RobotStatus, command: TrackerCommand) -> None:
        if self._stream is None:
            try:
                self._stream = socket.create_connection(self._address)
            except ConnectionRefusedError:
                return
            self._stream.sendall(b'{"hello": "arctrack", "version": 1}\n')
        self._seq += 1
        report = {
            "seq": self._seq,
            "time_us": round(1e6 * pose.timestamp_s),
            "position_mm": pose.position_base_mm,
            "quaternion_xyzw": pose.quaternion_xyzw,
            "command": command.command.name,
            "laser": command.laser_enable.name,
            "job": command.job_number,
        }
        names = ("mode", "motion", "welding", "arc", "emergency_stop", "correction")
        report |= {name: getattr(status, name).name for name in names}
        report |= {"current_a": status.current_a, "travel_speed_mm_s": status.travel_speed_mm_s}
        self._stream.sendall(json.dumps(report).encode() + b"\n")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._frames:
            if not select.select([self._stream] if self._stream else [], [], [], timeout)[0]:
                return None, True
            *lines, self._rest = (self._rest + self._stream.recv(65536)).split(b"\n")
            for answer in map(json.loads, lines):
                self._take(answer)
        return (self._frames.pop(0) if self._frames else None), True

    def _take(self, answer: dict) -> None:
        if "usable" not in answer or self._command is None:
            return
        self._rolling = (self._rolling + 1) % 256
        state = TrackerState[answer["state"]]
        heard = CommandHeard.DISARM if state is TrackerState.DISARMED else CommandHeard.OTHER
        self._put(
            TrackerHeartbeat(
                state=state,
                source=Source.LIVE,
                laser=LaserState.UNKNOWN,
                fault=Fault.NONE,
                request_number=self._command.request_number,
                request_result=RequestResult.NONE,
                job_number=1,
                rolling=self._rolling,
                command_heard=heard,
            )
        )
        if answer["usable"]:
            self.usable += 1
            self._put(SeamOffset(answer["y_mm"], answer["z_mm"], answer["age_ms"], 0.9, Validity.VALID))

    def _put(self, message: BusMessage) -> None:
        arbitration_id, data = self._protector.protect(message)
        self._frames.append(can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False))


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
def test_a_torch_is_led_to_the_seam_over_a_port(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        number = free.getsockname()[1]
    frames = f"serve-port-{os.getpid()}"
    cell = write_simulated_cell(tmp_path / "cell", PLAN, "tcp_json", f"127.0.0.1:{number}", frames)
    replace_in(cell, "# port = 8765", "port = 0")
    bus, off_mm, ends_s = JsonBus(number), [], time.monotonic() + 240.0
    with ChildProcess(run_camera, (PLAN, frames), ended=RuntimeError("the camera ended")) as camera:
        camera.receive()
        served = subprocess.Popen([sys.executable, "-c", SERVE, str(cell)], stdout=subprocess.PIPE, text=True)

        def goes_on(robot: Robot) -> bool:
            off_mm.append(math.hypot(*(robot.offset_mm - np.array(robot.world.seam_mm(robot.station_mm)))))
            assert served.poll() is None
            assert time.monotonic() < ends_s
            return bus.usable < 600

        try:
            run_robot(PLAN, bus, camera.send, goes_on)
        finally:
            served.terminate()
            said, _ = served.communicate()
            bus.shutdown()
    assert served.returncode == 0
    assert f"bus tcp_json:127.0.0.1:{number}" in said
    # It began 3 mm beside the seam, and was taken there.
    assert off_mm[0] == pytest.approx(PLAN.displaced_mm)
    assert max(off_mm[-50:]) < TORCH_MM
