"""A replay in a process of its own beside a robot on udp_multicast: how it ends, and what is used then."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from scipy.spatial.transform import Rotation

from arctrack.recording import Recording, read_recording
from arctrack.replay.replay_clock import assumed_command, assumed_robot
from robot_io import (
    Command,
    Link,
    OffsetUse,
    PoseKind,
    PoseStatus,
    Received,
    RobotPosePosition,
    RobotPoseRotation,
    SeamOffset,
    Source,
    TrackerStatus,
    Trusted,
    Validity,
)

pytestmark = pytest.mark.slow

PERIOD_S = 0.01


class Robot:
    """A live robot that goes where the recording's robot went, from the first word of the replay on."""

    def __init__(self, recording: Recording, bus: dict[str, Any]) -> None:
        self.link = Link(**bus, trusted=Trusted(tracker=(Source.REPLAY,)))
        self.received: list[Received] = []
        self.use = OffsetUse()
        self._recording, self._poses = recording, recording.pose_buffer()
        self._row = recording.rows[5]
        self._began_s: float | None = None

    def step(self) -> SeamOffset | None:
        """Speak and listen for a period; return the offset that counts then."""
        elapsed_s = 0.0 if self._began_s is None else time.monotonic() - self._began_s
        self.link.send(assumed_robot(self._row))
        armed = self._began_s is not None and elapsed_s > 0.05
        self.link.send(assumed_command(self._row, Command.TRACK if armed else Command.DISARM))
        pose = self._poses.at(self._recording.rows[0].timestamp_s + elapsed_s)
        if pose.status is not PoseStatus.REFUSED:
            x_mm, y_mm, z_mm = pose.T_base_tool[:3, 3]
            self.link.send(RobotPosePosition(x_mm, y_mm, z_mm, PoseKind.ACTUAL))
            x, y, z, w = Rotation.from_matrix(pose.T_base_tool[:3, :3]).as_quat()
            self.link.send(RobotPoseRotation.from_quaternion((x, y, z, w), 0.0))
        for received in self.link.receive(PERIOD_S):
            self.received.append(received)
            self.use.on_message(received, time.monotonic())
            if self._began_s is None:
                self._began_s = time.monotonic()
            if time.monotonic() - self._began_s > elapsed_s + PERIOD_S:
                break
        return self.use.offset(time.monotonic())

    @property
    def offsets(self) -> list[SeamOffset]:
        return [r.message for r in self.received if isinstance(r.message, SeamOffset)]

    @property
    def heard_valid(self) -> bool:
        return any(offset.validity is Validity.VALID for offset in self.offsets)

    @property
    def statuses(self) -> list[TrackerStatus]:
        return [r.message for r in self.received if isinstance(r.message, TrackerStatus)]


def replaying(path: Path, out: Path, bus: dict[str, Any]) -> subprocess.Popen[bytes]:
    """Start a replay onto a bus whose port is that of this test."""
    code = (
        # What a shell starts in the background ignores SIGINT, and so would its children.
        "import signal\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "import can.interfaces.udp_multicast.bus as udp\n"
        f"udp.UdpMulticastBus.DEFAULT_PORT = {bus['port']}\n"
        "init = udp.UdpMulticastBus.__init__\n"
        f"udp.UdpMulticastBus.__init__ = lambda self, channel, **o: init(self, channel, port={bus['port']}, "
        "hop_limit=0, **o)\n"
        "from arctrack.cli import main\n"
        "main()\n"
    )
    arguments = ["replay", str(path), "--out", str(out), "--no-pictures", "--onto-a-robot"]
    command = [sys.executable, "-c", code, *arguments, "--bus", f"udp_multicast:{bus['channel']}"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


ATTEMPTS = 5
"""A busy machine may be too late for a recording of a second, or for its signal: that is tried again."""


def ended(
    recording: Path, out: Path, bus: dict[str, Any], how: signal.Signals | None
) -> tuple[Robot, int, str]:
    """Replay beside a robot, and end it by a signal once an offset was valid."""
    robot = Robot(read_recording(recording), bus)
    process = replaying(recording, out, bus)
    # Who hangs is ended from outside; the test then fails by what it asserts.
    guard = threading.Timer(240.0, process.kill)
    guard.start()
    was_sent = False
    with robot.link, process:
        while process.poll() is None:
            robot.step()
            if how is not None and robot.heard_valid and not was_sent:
                process.send_signal(how)
                was_sent = True
        guard.cancel()
        _, errors = process.communicate()
        ended_s = time.monotonic()
        heard = -1
        # A busy machine may give the robot no turn in that time, and the last words still wait to be read.
        while time.monotonic() - ended_s < 0.16 or heard < len(robot.received):
            heard = len(robot.received)
            robot.step()
        assert robot.step() is None
    return robot, process.returncode, errors.decode()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL, None])
def test_however_a_replay_ends_no_offset_counts_any_more(
    compiled: None, simulated: Path, tmp_path: Path, multicast: dict[str, Any], how: signal.Signals | None
) -> None:
    for _ in range(ATTEMPTS):
        robot, code, errors = ended(simulated, tmp_path / "out", multicast, how)
        # A signal may come after the replay's own end.
        if robot.heard_valid and (how is None or code != 0):
            break
    assert robot.heard_valid, ({status.gate_reason for status in robot.statuses}, errors)
    if how is signal.SIGKILL:
        assert code == -signal.SIGKILL
        return
    assert robot.offsets[-1].validity is Validity.REFUSED
    assert code == (0 if how is None else 130), errors


INTERRUPTED = """
import random
import signal
import sys
import time

from arctrack.recording import read_recording
from arctrack.replay.replay import ReplayOptions, replay_recording

recording, options = read_recording(sys.argv[1]), ReplayOptions(pictures=False)
replay_recording(recording, sys.argv[2], options)
began_s = time.monotonic()
replay_recording(recording, sys.argv[2], options)
takes_s = time.monotonic() - began_s
# What a shell starts in the background ignores SIGINT.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
rng, interrupts = random.Random(1), 0
for _ in range(60):
    try:
        signal.setitimer(signal.ITIMER_REAL, rng.uniform(0.1, 1.0) * takes_s)
        replay_recording(recording, sys.argv[2], options)
        time.sleep(takes_s)
    except KeyboardInterrupt:
        interrupts += 1
print(interrupts)
"""


def test_an_interrupt_at_any_moment_ends_a_replay_and_nothing_else(
    compiled: None, simulated: Path, tmp_path: Path
) -> None:
    """In a kernel, in the bus' log, in what hands over frames: no crash, no hang, no other error."""
    command = [sys.executable, "-c", INTERRUPTED, str(simulated), str(tmp_path / "out")]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)
    assert finished.returncode == 0, finished.stderr
    assert int(finished.stdout) > 30
