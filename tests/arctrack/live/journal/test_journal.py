"""A live run's journal: what is written comes out the same, newest first, and what is gone is None."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from arctrack.live.journal import private_memory
from arctrack.live.journal.journal import MIN_SLOTS, Journal, JournalReader, gap_name, slots_for
from arctrack.live.journal.private_memory import private_path
from arctrack.live.journal.records import (
    Entry,
    FrameView,
    GapReport,
    ProcessState,
    ReceivedPose,
    Status,
    pack,
)
from arctrack.live.journal.ring import RingError, RingWriter
from arctrack.simulation.cell.robot import WELDING
from robot_io import (
    Command,
    Fault,
    GateReason,
    LaserState,
    PoseKind,
    PoseSample,
    SeamOffset,
    Source,
    Switch,
    TrackerCommand,
    TrackerState,
    Validity,
)
from tracker.state import Frame, Pose, Track
from tracker.step import StepInputs
from tracker.tracker_state import TrackerMemory as SteppedState

SHAPE = (6, 8)


OFFSET = SeamOffset(0.1, -0.2, 24.0, 0.9, Validity.VALID)


@pytest.fixture
def journal(tmp_path, monkeypatch):
    monkeypatch.setattr(private_memory, "MEMORY", tmp_path)
    journal = Journal("run", SHAPE, np.uint16, MIN_SLOTS)
    yield journal
    journal.close()
    assert not list(private_path("").iterdir())


def entry(index):
    image = np.full(SHAPE, 1000 * index, np.uint16)
    pose = Pose(np.diag([1.0, 1.0, 1.0, 1.0 + index]))
    return Entry(
        Frame(index, index / 3.0, image, 0.005),
        StepInputs(SteppedState(), pose),
        Track(index, 0.0, 0),
        OFFSET,
        1,
    )


def test_an_entry_comes_out_as_it_was_written(journal):
    pose = ReceivedPose(PoseSample(1 / 3, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), PoseKind.ACTUAL, 0.004), 0.5)
    journal.add_pose(pose)
    assert journal.write_entry(entry(7)) == 0
    assert journal.write_entry(entry(8)) == 1
    reader = JournalReader("run")
    read = reader.entry(0)
    assert read.frame.timestamp_s == 7 / 3.0
    np.testing.assert_array_equal(read.frame.image_dn, np.full(SHAPE, 7000, np.uint16))
    np.testing.assert_array_equal(read.inputs.pose.T_base_tool, entry(7).inputs.pose.T_base_tool)
    assert read.poses == (pose,)
    assert reader.entry(1).poses == ()
    assert reader.entry(2) is None
    reader.close()


def test_the_oldest_entries_go(journal):
    for index in range(20):
        journal.write_entry(entry(index))
    reader = JournalReader("run")
    assert (reader.count, reader.first) == (20, 20 - MIN_SLOTS)
    assert reader.entry(reader.first - 1) is None
    assert [reader.entry(k).frame.index for k in range(reader.first, 20)] == list(range(12, 20))
    reader.close()


def test_the_newest_view_and_status_are_told(journal):
    reader = JournalReader("run")
    assert reader.newest_view() is None
    assert reader.status() is None
    for index in range(9):
        journal.write_view(FrameView(index, Track(index, 0.0, 0)))
    assert reader.newest_view().position == 8
    reader.close()


def test_a_status_comes_out_as_it_was_told(journal):
    told = Status(
        now_s=1 / 3,
        wall_s=2 / 3,
        source=Source.LIVE,
        state=TrackerState.TRACKING,
        fault=Fault.NONE,
        laser=LaserState.ON,
        reason=GateReason.CAMERA_STOPPED,
        offset=OFFSET,
        robot=WELDING,
        command=TrackerCommand(Command.TRACK, True, True, 0, 7, None, Switch.ON),
        job_number=7,
        frames=2**40,
        valid=3,
        dropped=0,
        offsets={"VALID": 3},
        processes={"page": ProcessState(17, False, 2, "its process ended")},
        arrival_ms=(1.0, 2.0, 3.0),
        frame_s=0.3,
    )
    journal.write_status(told)
    reader = JournalReader("run")
    np.testing.assert_equal(asdict(reader.status()), asdict(told))
    reader.close()


def test_gap_reports_are_read_while_somebody_writes_them(journal):
    reader = JournalReader("run")
    for text in ("window film", "arc lower"):
        assert reader.gap() is None
        with RingWriter(gap_name("run"), 4, 4096) as gaps:
            assert reader.gap() is None
            gaps.write(pack(GapReport(1.0, True, text)))
            assert reader.gap().text == text
    reader.close()


def test_what_does_not_fit_is_counted_and_nothing_raises(journal):
    large = entry(1)
    journal.write_entry(
        Entry(large.frame, large.inputs, Track(1, 0.0, 0, stripe=np.zeros(20_000)), OFFSET, 1)
    )
    assert journal.lost == 1
    assert JournalReader("run").count == 0


def test_a_reader_without_a_run_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(private_memory, "MEMORY", tmp_path)
    with pytest.raises(RingError, match="nobody"):
        JournalReader("run")


def test_what_is_saved_is_not_written_over_meanwhile():
    assert slots_for(30.0, 200.0) == 7500
    assert slots_for(0.0, 25.0) == MIN_SLOTS
