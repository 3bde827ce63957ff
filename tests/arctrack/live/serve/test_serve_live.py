"""The closed loop as processes on a real bus: a simulated cell, and the tracker that serves it."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import pytest
import tomlkit
from made import replace_in, results_of
from scipy.spatial.transform import Rotation

from arctrack.live.cameras.shared_frames import SharedFramesReader
from arctrack.live.serve.simulated import (
    GROUP,
    INTERFACE,
    SimulatedCell,
    TorchError,
    torch_error,
    write_simulated_cell,
)
from arctrack.simulation.cell.cell import TORCH_MM
from arctrack.simulation.cell.weld.closed_loop import LoopPlan
from robot_io import (
    ANY_SOURCE,
    Command,
    FindAnswer,
    FindAssembler,
    FindRefusal,
    GateLimits,
    Inbox,
    OffsetUse,
    RequestResult,
    SeamOffset,
    TrackerCommand,
    TrackerHeartbeat,
    Validity,
)

PLAN = LoopPlan(joint="lap", length_mm=1000.0, rate_hz=10.0, size_px=(160, 120))

SENT = ("offset_y_mm", "offset_z_mm", "compute_ms", "pose_doubt", "validity", "gate_reason")
"""Columns that say what went out, and when."""

BUSY_MACHINE = {
    "gate": {"capture_age_s": 1.0},
    "service": {
        "status_age_s": 1.0,
        "command_age_s": 1.0,
        "poses_age_s": 1.0,
        "camera_timeout_s": 1.0,
        "round_trip_s": 1.0,
        "round_trip_age_s": 2.0,
        "watchdog_s": 20.0,
    },
    "plausibility": {"gap_s": 1.0},
}
"""Times of a cell whose tests share their processors with others."""

REPLAY = "import sys; from arctrack.cli import main; sys.argv[1:1] = ['replay']; main()"

TRACKER = """
    import sys
    from arctrack.control.cell_file import read_cell_file
    from arctrack.cli import console
    from arctrack.cli.serve import serve_cell_file
    from tracker.warm_up import compilations_reported

    say, seen = console.say, []

    def noted(*lines):
        seen.append((set(sys.modules), len(compiled)))
        say(*lines)

    console.say = noted
    with compilations_reported(None) as compiled:
        serve_cell_file(read_cell_file(sys.argv[1]), port=int(sys.argv[2]), hop_limit=0)
    ready, ended = seen
    print(f"after ready: loaded {sorted(ended[0] - ready[0])}, compiled {ended[1] - ready[1]}")
"""


class Ear:
    """What a robot hears on the bus."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus, self.inbox, self.use = bus, Inbox(ANY_SOURCE), OffsetUse()
        self.messages: list = []
        self.finds, self.answers = FindAssembler(), list[FindAnswer]()

    def listen(self, is_so, seconds: float = 240.0) -> None:
        """Listen until something is so."""
        until_s = time.monotonic() + seconds
        while not is_so():
            assert time.monotonic() < until_s, self.messages[-20:]
            frame = self.bus.recv(0.05)
            received = None if frame is None else self.inbox.receive(frame)
            if received is not None:
                self.messages.append(received.message)
                self.use.on_message(received, time.monotonic())
                answer = self.finds.push(received)
                self.answers += [] if answer is None else [answer]

    def is_usable(self) -> bool:
        return self.use.offset(time.monotonic()) is not None

    def offsets(self) -> list[SeamOffset]:
        return [message for message in self.messages if isinstance(message, SeamOffset)]

    def valid(self) -> list[SeamOffset]:
        return [offset for offset in self.offsets() if offset.validity is Validity.VALID]


@contextmanager
def served(
    multicast: dict[str, Any], folder: Path, plan: LoopPlan
) -> Iterator[tuple[SimulatedCell, Ear, subprocess.Popen]]:
    """Yield a simulated cell, what is heard on its bus, and the tracker in a process of its own."""
    name = f"{folder.name}-{os.getpid()}"
    cell = write_simulated_cell(folder / "cell", plan, INTERFACE, GROUP, name)
    _allow_delays(cell)
    with (
        SimulatedCell(plan, name) as robot,
        can.Bus(**(multicast | robot.bus_options), ignore_config=True) as bus,
    ):
        ear, process = Ear(bus), started(TRACKER, str(cell), str(robot.bus_options["port"]))
        try:
            yield robot, ear, process
        finally:
            process.kill()
            process.communicate()


def _allow_delays(cell: Path) -> None:
    document = tomlkit.parse(cell.read_text())
    for table, times in BUSY_MACHINE.items():
        document[table].update(times)
    cell.write_text(tomlkit.dumps(document))


def started(script: str, *words: str) -> subprocess.Popen:
    command = [sys.executable, "-c", textwrap.dedent(script), *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
def test_a_robot_follows_offsets_of_another_process_until_that_ends_or_is_killed(multicast, tmp_path: Path):
    name = f"serve-{os.getpid()}"
    cell = write_simulated_cell(tmp_path / "cell", PLAN, INTERFACE, GROUP, name)
    _allow_delays(cell)
    replace_in(cell, "# port = 8765", "port = 0")
    processes = []
    try:
        with (
            SimulatedCell(PLAN, name) as robot,
            can.Bus(**(multicast | robot.bus_options), ignore_config=True) as bus,
            SharedFramesReader(name) as camera,
        ):
            ear, words = Ear(bus), (str(cell), str(robot.bus_options["port"]))
            processes.append(started(TRACKER, *words))
            ear.listen(lambda: len(ear.valid()) >= 20)
            ear.listen(ear.is_usable)
            _check_offsets(ear)

            processes[0].send_signal(signal.SIGUSR1)
            boxes = cell.parent / "black_box"
            ear.listen(lambda: any(boxes.glob("*_asked_by_SIGUSR1")))
            processes[0].send_signal(signal.SIGTERM)
            ear.listen(lambda: processes[0].poll() is not None)
            assert processes[0].returncode == 0
            page, ready, saved, said, *_, late = processes[0].stdout.read().splitlines()
            assert page.startswith("page: http://127.0.0.1:")
            assert ready.startswith(f"ready: shared_memory {name}, bus udp_multicast:239.74.163.2")
            assert saved.startswith("black box: saved ")
            assert said.endswith(" offsets sent")
            assert late == "after ready: loaded [], compiled 0"
            # What the robot says next came after all of that.
            heard = len(ear.messages)
            ear.listen(lambda: sum(isinstance(m, TrackerCommand) for m in ear.messages[heard:]) >= 2)
            assert ear.offsets()[-1].validity is Validity.REFUSED
            assert not ear.is_usable()

            processes.append(started(TRACKER, *words))
            before = len(ear.valid())
            # What is killed leaves frames that a replay can follow.
            ear.listen(lambda: len(ear.valid()) >= before + 5)
            ear.listen(ear.is_usable)
            processes[1].kill()
            ear.listen(lambda: not ear.is_usable())
            # Nobody keeps the laser on.
            dark: list = []
            ear.listen(lambda: _is_dark(camera, dark))
            samples = robot.stop()
        _check_black_boxes(boxes)
        # It began 3 mm beside the seam, and was taken there.
        assert samples[0][1] == pytest.approx(PLAN.displaced_mm)
        assert min(off_mm for _, off_mm in samples) < 0.5
    finally:
        for process in processes:
            process.kill()
            process.communicate()


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
def test_a_robot_that_turns_on_a_circle_follows_the_offsets_of_another_process(multicast, tmp_path: Path):
    plan = replace(PLAN, path="circle:60", length_mm=280.0, displaced_mm=1.0)
    with served(multicast, tmp_path, plan) as (robot, ear, _):
        ear.listen(lambda: len(ear.valid()) >= 20)
        samples = robot.stop()
    # The part lies 1 mm to the left of the start and 1 mm along it.
    assert samples[0][1] == pytest.approx(1.0)
    assert min(off_mm for _, off_mm in samples) < 0.2
    # What is to the left turns with the robot: of such a part no more than its whole displacement.
    assert max(abs(o.offset_y_mm) for o in ear.valid()) < 2.0**0.5 + 0.3


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
def test_a_robot_that_asks_is_told_where_the_joint_is_and_then_follows_it(multicast, tmp_path: Path):
    plan = replace(PLAN, finds_first=True)
    with served(multicast, tmp_path, plan) as (robot, ear, process):
        ear.listen(lambda: any(answer.is_found for answer in ear.answers))
        ear.listen(ear.is_usable)
        process.send_signal(signal.SIGTERM)
        ear.listen(lambda: process.poll() is not None)
        assert process.stdout.read().splitlines()[-1] == "after ready: loaded [], compiled 0"
        robot.stop()
    # A machine that is busy delays the bus: then the robot asks again, and each is answered once.
    *refused, answer = ear.answers
    assert not any(each.is_found for each in refused)
    numbers = [each.result.request_number for each in ear.answers]
    assert len(set(numbers)) == len(numbers)
    result, position, rotation = answer.result, answer.position, answer.rotation
    assert result.refusal is FindRefusal.NONE
    asked = [m for m in ear.messages if isinstance(m, TrackerCommand) and m.command is Command.FIND]
    assert {m.request_number for m in asked} == set(numbers)
    beats = [m for m in ear.messages if isinstance(m, TrackerHeartbeat)]
    assert (result.request_number, RequestResult.DONE) in {
        (beat.request_number, beat.request_result) for beat in beats
    }
    # The seam lies to the left of the path, along x, and the robot stands where its path begins.
    assert position.y_mm == pytest.approx(plan.displaced_mm, abs=max(0.1, 3.0 * result.sigma_y_mm))
    assert 0.0 < result.sigma_y_mm < 0.5
    along, _, up = Rotation.from_quat(rotation.quaternion_xyzw).as_matrix().T
    assert along[0] > 0.99
    assert up[2] > 0.99
    assert math.isnan(rotation.direction_sigma_deg)


def _check_black_boxes(folder: Path) -> None:
    """Replay what was saved on request, and of the run that was killed: to the tracks of the runs."""
    (asked,), (killed,) = folder.glob("*_asked_by_SIGUSR1"), folder.glob("*_run_ended_by_itself")
    for saved in (asked, killed):
        _check_replays(saved)


def _check_replays(saved: Path) -> None:
    """Replay a recording of a run as a user does, in a process of its own: to the tracks of the run."""
    command = [sys.executable, "-c", REPLAY, str(saved), "--no-pictures", "--out", str(saved / "again")]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    again, live = results_of(saved / "again"), results_of(saved / "live")
    assert any(row["valid"] == "1" for row in live)
    assert [told(row) for row in again] == [told(row) for row in live]


def told(row: dict[str, str]) -> dict[str, str]:
    """Return what a row says of the track; a live run estimates no height of the arc."""
    return {name: cell for name, cell in row.items() if not name.startswith(("run_", "arc_height", *SENT))}


def _check_offsets(ear: Ear) -> None:
    """Check that nothing was VALID before the robot wanted it, and nothing beyond the gate's limits."""
    armed = next(
        n
        for n, message in enumerate(ear.messages)
        if isinstance(message, TrackerCommand) and message.command is Command.TRACK
    )
    before = [m.validity for m in ear.messages[:armed] if isinstance(m, SeamOffset)]
    assert set(before) == {Validity.REFUSED}
    limits = GateLimits()
    valid = [offset for offset in ear.offsets() if offset.validity is Validity.VALID]
    assert max(abs(offset.offset_y_mm) for offset in valid) <= limits.range_y_mm
    assert max(abs(offset.offset_z_mm) for offset in valid) <= limits.range_z_mm
    assert valid[-1].offset_y_mm == pytest.approx(PLAN.displaced_mm, abs=0.3)


def test_the_torch_is_judged_from_the_lock_to_the_end() -> None:
    samples = [(0.0, 3.0), (1.0, 0.3), (2.0, 0.4), (3.0, 2.0)]
    judged = torch_error(samples, 0.5, 2.5)
    assert judged == TorchError(pytest.approx(0.125**0.5), 0.4, 2.0)
    assert torch_error(samples, float("inf"), 2.5) is None
    assert TorchError(0.1, TORCH_MM, 1.0).is_on_seam
    assert not TorchError(0.1, 1.01 * TORCH_MM, 1.0).is_on_seam


def _is_dark(camera: SharedFramesReader, dark: list) -> bool:
    frame = camera.newest()
    if frame is not None and not frame.laser_on:
        dark.append(frame)
    return bool(dark)
