"""A run for the page to show: the example's frames, tracked, and written into a journal over and over."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

from arctrack.live.journal.journal import MIN_SLOTS, Journal, gap_name
from arctrack.live.journal.message_pipe import PipeEnd, message_pipe
from arctrack.live.journal.records import Entry, FrameView, GapReport, Status, pack
from arctrack.live.journal.ring import RingWriter
from arctrack.live.monitor.monitor_process import run_monitor
from arctrack.live.monitor.options import MonitorOptions
from arctrack.live.serve.supervisor import SupervisedProcess, Supervisor
from arctrack.recording import Recording, read_recording
from arctrack.simulation.cell.robot import WELDING
from robot_io import (
    Command,
    Fault,
    GateReason,
    LaserState,
    SeamOffset,
    Source,
    Switch,
    TrackerCommand,
    TrackerState,
    Validity,
)
from tracker.step import StepInputs
from tracker.tracker import Tracker

EXAMPLE = Path(__file__).parents[4] / "examples" / "v_groove"
PERIOD_S = 0.05
FIRST, FRAMES = 6, 8
"""The example's first frames show laser or arc alone."""

TITLE = "cell.toml, shared_memory side_wall"
TOKEN = "a token of the tests"

Tracked = tuple[Entry, FrameView]


@cache
def example() -> Recording:
    return read_recording(EXAMPLE)


@cache
def tracked() -> Sequence[Tracked]:
    """Return entries and views of some of the example's frames."""
    recording = example()
    tracker, poses = Tracker(recording.setup), recording.pose_buffer()
    shown = []
    for position, frame in enumerate(recording.frames(range(FIRST, FIRST + FRAMES))):
        pose = recording.pose_at(poses, frame.timestamp_s)
        before = tracker.state
        track = tracker.step(frame, pose)
        reading = tracker.reading
        validity = Validity.VALID if track.valid else Validity.REFUSED
        offset = SeamOffset(track.offset_y_mm, track.offset_z_mm, 24.0, 0.98, validity)
        entry = Entry(
            frame, StepInputs(before, pose), replace(track, stripe=None, checks=()), offset, 7, took_ms=4.0
        )
        view = FrameView(
            position, replace(track, checks=()), reading.seam, reading.reach_mm, reading.arc, reading.joint
        )
        shown.append((entry, view))
    return shown


class ShownRun:
    """Writes a run's journal, twenty frames a second, until it is told to stop.

    Tests put into `changes` what the next statuses are to say.
    """

    def __init__(self, name: str) -> None:
        height, width = tracked()[0][0].frame.image_dn.shape
        self.journal = Journal(name, (height, width), example().setup.sensor.dtype, MIN_SLOTS)
        self.gaps: RingWriter | None = None
        self.changes: dict[str, object] = {}
        self.status = Status(
            now_s=0.0,
            wall_s=0.0,
            source=Source.LIVE,
            state=TrackerState.TRACKING,
            fault=Fault.NONE,
            laser=LaserState.ON,
            reason=GateReason.NONE,
            offset=None,
            robot=replace(WELDING, weave=Switch.OFF, travel_speed_mm_s=4.0, path_section=1),
            command=TrackerCommand(Command.TRACK, True, True, 0, 7, None, Switch.ON),
            job_number=7,
            frames=0,
            valid=0,
            dropped=3,
            offsets={"VALID": 11, "REFUSED": 2},
            reasons={"NOT_ARMED": 2},
            faults={"repeated": 1},
            capture_ms=(24.0, 31.5, 40.0),
            arrival_ms=(4.0, 8.0, 11.0),
            processor_wait=0.12,
            capture_counts=(0, 0, 0, 11, 11, 11, 11, 11, 11, 11, 11, 11, 11),
            capture_sum_s=0.3,
        )
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._write)
        self._began_s = time.monotonic()
        self.count = 0
        self.turn()
        self._thread.start()

    def turn(self) -> None:
        """Write the next frame."""
        entry, view = tracked()[self.count % FRAMES]
        now_s = time.monotonic()
        frame = replace(entry.frame, index=self.count, timestamp_s=now_s - 0.024)
        entry = replace(entry, frame=frame, arrived_s=now_s - 0.005, sent_s=now_s)
        self.count += 1
        self.status = replace(
            self.status,
            now_s=now_s,
            wall_s=time.time(),
            frames=self.count,
            valid=self.count,
            frame_s=frame.timestamp_s,
            offset=entry.offset,
            offsets={"VALID": 11 + self.count, "REFUSED": 2},
        )
        self.status = replace(self.status, **self.changes)
        position = self.journal.write_entry(entry)
        track = replace(view.track, frame=frame.index, timestamp_s=frame.timestamp_s)
        self.journal.write_view(replace(view, position=position, track=track))
        self.journal.write_status(self.status)

    def report_gap(self, name: str, text: str) -> None:
        """Let a gap watch say what it sees."""
        self.gaps = RingWriter(gap_name(name), 4, 4096)
        report = GapReport(0.0, True, text, time.time() - 60.0, 2.61, 0.04)
        self.gaps.write(pack(report))

    def _write(self) -> None:
        while not self._ended.wait(PERIOD_S):
            self.turn()

    def stop(self) -> None:
        """Write no more."""
        self._ended.set()
        self._thread.join()

    def close(self) -> None:
        self.stop()
        self.journal.close()
        if self.gaps is not None:
            self.gaps.close()


def answering_black_box() -> PipeEnd:
    """Return an end of a connection; at the other one what is asked to be saved is saved."""
    black_box, asked = message_pipe()

    def answer() -> None:
        with suppress(EOFError, ConnectionResetError):
            while True:
                black_box.send({"saved": f"black_boxes/{black_box.recv()['save']}"})

    threading.Thread(target=answer, daemon=True).start()
    return asked


@contextmanager
def shown_run(suffix: str, black_box: PipeEnd | None = None) -> Iterator[tuple[ShownRun, str, str]]:
    """Yield a run, its name, and the address of its page, in a process of its own."""
    name = f"monitor-{suffix}-{os.getpid()}"
    setup = example().setup
    options = MonitorOptions(name, {7: setup}, token=TOKEN, title=TITLE, job_names={7: "side wall"})
    run = ShownRun(name)
    try:
        others = () if black_box is None else (black_box,)
        with Supervisor(print).running(SupervisedProcess("monitor", run_monitor, (options,), others)) as page:
            yield run, name, page.wait_ready()
    finally:
        run.close()
