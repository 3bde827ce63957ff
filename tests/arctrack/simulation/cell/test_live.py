"""The cell as two processes of its own, and a tracker's side of it in this one."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import textwrap
import time
from dataclasses import replace

import can
import numpy as np
import pytest
from heartbeat import BEAT
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.control.cell_file import CameraChoice, read_cell_file
from arctrack.errors import ArctrackError
from arctrack.live.cameras.shared_frames import SharedFramesError, SharedFramesReader, path_of
from arctrack.live.simulated_cell import RealBus, RealTimeScheduler, serve_cell
from arctrack.simulation.cell.weld.closed_loop import LoopPlan, setup_of
from robot_io import (
    SOURCES,
    Command,
    Inbox,
    PoseAssembler,
    Protector,
    RobotStatus,
    SeamOffset,
    Source,
    TrackerCommand,
    Trusted,
    Validity,
)
from tracker.state import Pose
from tracker.tracker import Tracker

PATIENCE_S = 120.0

SERVE = """
    import sys
    from arctrack.live.simulated_cell import serve_cell
    from arctrack.simulation.cell.weld.closed_loop import LoopPlan
    plan = LoopPlan(joint="lap", displaced_mm=3.0, weave_mm=0.0, length_mm=1000.0, rate_hz=5.0)
    frames, port = sys.argv[1], int(sys.argv[2])
    serve_cell(
        plan, "udp_multicast", "239.74.163.2", frames, lambda robot: robot.now_s < 60.0,
        lambda: print("ready", flush=True), port=port, hop_limit=0,
    )
"""


class Heard:
    """What a tracker hears of the robot."""

    def __init__(self, bus):
        self.bus, self.inbox, self.poses = bus, Inbox(Trusted(SOURCES, SOURCES)), PoseAssembler()
        self.last = {}

    def listen(self, seconds):
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            message = self.bus.recv(0.05)
            if message is None:
                continue
            message.timestamp = time.monotonic()
            received = self.inbox.receive(message)
            if received is not None:
                self.last[type(received.message)] = received.message
                sample = self.poses.push(received)
                if sample is not None:
                    self.last["pose"] = sample

    def until(self, is_so):
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            self.listen(0.1)
            if is_so(self.last):
                return
        raise AssertionError(f"did not come: {self.last}")


@pytest.mark.slow
def test_a_robot_and_its_camera_are_processes_that_a_tracker_finds_and_that_leave_nothing(multicast):
    name = f"test-{os.getpid()}"
    words = [sys.executable, "-c", textwrap.dedent(SERVE), name, str(multicast["port"])]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "ready\n"
        with can.Bus(**multicast, ignore_config=True) as bus, SharedFramesReader(name) as reader:
            heard = Heard(bus)
            heard.until(lambda last: {RobotStatus, TrackerCommand, "pose"} <= set(last))
            protector = Protector(Source.LIVE)

            def send(message):
                arbitration_id, data = protector.protect(message)
                bus.send(can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False))

            # Nothing is wanted of a tracker that was not heard.
            assert heard.last[TrackerCommand].command is Command.DISARM
            beats = itertools.count()

            def is_followed(last):
                send(replace(BEAT, rolling=next(beats) % 16))
                return last[TrackerCommand].command is Command.TRACK

            heard.until(is_followed)
            heard.until(lambda last: last[TrackerCommand].command is Command.DISARM)
            for _ in range(2):
                # Absolute: twice the same is once.
                send(SeamOffset(1.0, 0.0, 20.0, 0.9, Validity.VALID))
                time.sleep(0.02)
            heard.until(lambda last: last["pose"].position_base_mm[1] > 0.95)
            heard.listen(0.5)
            x_mm, y_mm, z_mm = heard.last["pose"].position_base_mm
            assert y_mm == pytest.approx(1.0, abs=0.05)
            asked_s, frames = time.monotonic(), [reader.newest()]

            def is_new(_):
                frames.append(reader.newest() or frames[-1])
                return frames[-1] is not None and frames[-1].timestamp_s >= asked_s

            heard.until(is_new)
            # The clock is the machine's, and the image shows the seam where it truly lies.
            frame = frames[-1]
            assert frame.timestamp_s < time.monotonic()
            T_base_tool = np.eye(4)
            T_base_tool[:3, 3] = x_mm, y_mm, z_mm
            track = Tracker(setup_of(LoopPlan(joint="lap"))).step(frame, Pose(T_base_tool))
            assert track.valid
            assert y_mm + track.seam_tool_mm[1] == pytest.approx(3.0, abs=0.2)
            process.kill()
            process.wait(10.0)
            until_s = time.monotonic() + PATIENCE_S
            while reader.is_writer_alive and time.monotonic() < until_s:
                time.sleep(0.05)
            assert not reader.is_writer_alive
        assert not path_of(name).exists()
        with pytest.raises(SharedFramesError, match="nobody publishes"):
            SharedFramesReader(name)
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_the_command_says_where_robot_and_frames_are(tmp_path):
    name = f"command-{os.getpid()}"
    words = ["cell", "serve", "--bus", "virtual:live", "--frames", name, "--seconds", "0.2"]
    words += ["--write-cell", str(tmp_path / "cell")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert f"robot on virtual:live, frames as '{name}'" in done.output
    cell = read_cell_file(tmp_path / "cell" / "cell.toml")
    assert str(cell.bus) == "virtual:live"
    assert cell.camera == CameraChoice(10.0, "shared_memory", name)
    assert (cell.setup.setup.camera.width, cell.setup.setup.joint.type) == (320, "lap")
    assert not path_of(name).exists()


def test_a_bus_that_there_is_not_is_named():
    plan = LoopPlan(joint="lap")
    with pytest.raises(ArctrackError, match=r"--bus nosuch:bus: ") as raised:
        serve_cell(plan, "nosuch", "bus", "frames", lambda robot: False)
    assert "\n" not in str(raised.value)


def test_a_real_bus_drops_its_own_echo_and_counts_what_it_cannot_send():
    own = can.Bus("live", interface="virtual", receive_own_messages=True)
    with own, can.Bus("live", interface="virtual") as other:
        bus, heard = RealBus(own, RealTimeScheduler()), []
        bus.join("robot", heard.append)
        bus.send("robot", 0x123, b"abc")
        bus.listen(0.1)
        assert heard == []
        assert other.recv(0.1).data == b"abc"
        other.send(can.Message(arbitration_id=0x124, data=b"xyz", is_extended_id=False))
        bus.listen(0.1)
        assert [(frame.arbitration_id, frame.data) for frame in heard] == [(0x124, b"xyz")]
    bus.send("robot", 0x123, b"abc")
    assert bus.unsent == 1


def test_a_real_time_scheduler_does_in_order_what_is_due():
    scheduler, done = RealTimeScheduler(), []
    scheduler.at(0.03, lambda: done.append("later"))
    scheduler.at(0.01, lambda: done.append("sooner"))
    scheduler.run_while(lambda: len(done) < 2, time.sleep)
    assert done == ["sooner", "later"]
    assert scheduler.now_s >= 0.03
