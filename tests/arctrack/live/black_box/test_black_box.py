"""A live run's black box: its recording replays to the tracks of the run, bit for bit."""

from __future__ import annotations

import csv
import json
import math
import multiprocessing
import re
from dataclasses import asdict, replace
from itertools import takewhile
from pathlib import Path
from queue import SimpleQueue
from threading import Thread

import numpy as np
import pytest
from made import playing_cell
from pydantic import TypeAdapter

from arctrack.control.cell_file import read_cell_file
from arctrack.control.cell_file.job_setup import job_setup_text
from arctrack.control.frame_tracking import Capture, FrameTracking
from arctrack.control.recorded_job import recorded_job
from arctrack.control.tracking_service import FrameOutcome
from arctrack.errors import ArctrackError
from arctrack.live.black_box import recorder
from arctrack.live.black_box.client import BlackBoxClient
from arctrack.live.black_box.recorder import (
    END,
    FaultWatch,
    JobSetup,
    RecorderOptions,
    run_recorder,
    save_window,
)
from arctrack.live.journal import private_memory
from arctrack.live.journal.journal import Journal, JournalReader, slots_for
from arctrack.live.journal.message_pipe import message_pipe
from arctrack.live.journal.records import Status
from arctrack.live.serve.journal_writer import JournalWriter
from arctrack.live.serve.live_run import run, run_parts
from arctrack.live.serve.loop import LiveLoop
from arctrack.recording import Recording, read_recording
from arctrack.recording.live_steps import read_state, write_state
from arctrack.recording.run_offsets import OffsetOutcome, RunComparison, read_run_offsets
from arctrack.replay.replay import replay_recording
from arctrack.replay.replay_loop import replay_without_bus
from robot_io import (
    Fault,
    GateReason,
    LaserState,
    Link,
    PoseStatus,
    SeamOffset,
    Source,
    TrackerState,
    Validity,
)
from robot_io.poses.pose_questions import Implausibility
from tracker.state import AT_ONCE, OffsetLookAhead, Track
from tracker.tracker_state import TrackerMemory as SteppedState

RUN = "black-box"
EXAMPLE = Path(__file__).resolve().parents[4] / "examples" / "v_groove"


@pytest.fixture
def memory(tmp_path, monkeypatch):
    folder = tmp_path / "memory"
    folder.mkdir()
    monkeypatch.setattr(private_memory, "MEMORY", folder)
    return folder


def replayed_tracks(saved: Recording) -> list[Track]:
    replayed = replay_without_bus(recorded_job(saved), range(len(saved.rows)))
    return [outcome.tracked.track for _, _, outcome in replayed]


def told(track: Track) -> dict:
    return asdict(replace(track, stripe=None, checks=()))


class Run:
    """The example as a live run sees it: poses that are doubted or refused, a seam that begins anew."""

    def __init__(self, journal: Journal) -> None:
        self.recording = read_recording(EXAMPLE)
        self.setup = self.recording.setup
        self.tracking = FrameTracking(self.setup, self.recording.correction)
        self.journal_writer = JournalWriter(journal)
        self.tracks: list[Track] = []

    def go(self, frames: int) -> None:
        buffer = self.recording.pose_buffer()
        for n, frame in enumerate(list(self.recording.frames(range(frames)))):
            pose = buffer.at(frame.timestamp_s)
            if n == 3:
                pose = replace(pose, status=PoseStatus.REFUSED)
            if n == 9:
                self.tracking.begin()
            lead = AT_ONCE if n < 5 else OffsetLookAhead(0.01 * n / 3.0, n / 7.0)
            capture = Capture(frame.index, frame.timestamp_s, pose, None, n not in (6, 7), lead)
            tracked = replace(self.tracking.track(frame, capture), took_ms=2.0)
            self.tracks.append(tracked.track)
            offset, reason, doubt = SeamOffset(0.1 * n, 0.0, 10.0, 0.9, Validity.VALID), GateReason.NONE, None
            if n == 7:
                offset, reason = replace(offset, validity=Validity.HELD), GateReason.CAPTURE_TOO_OLD
            elif n == 8:
                offset = SeamOffset(math.nan, math.nan, math.nan, math.nan, Validity.REFUSED)
                reason, doubt = GateReason.POSE_IMPLAUSIBLE, Implausibility.STOPPED
            arrived_s, sent_s = frame.timestamp_s + 0.01, math.nan if n == 10 else frame.timestamp_s + 0.02
            outcome = FrameOutcome(tracked, None, [], offset, sent_s, reason, doubt)
            self.journal_writer.on_sent(outcome, 1, arrived_s, 0)

    @property
    def jobs(self) -> dict[int, JobSetup]:
        return {1: JobSetup(self.setup, (EXAMPLE / "recording.toml").read_text())}

    def journal_for(self) -> tuple[tuple[int, int], str]:
        return (self.setup.camera.height, self.setup.camera.width), str(self.setup.sensor.dtype)


def a_run(frames: int = 14, slots: int = 40) -> tuple[Run, Journal]:
    camera, sensor = (setup := read_recording(EXAMPLE).setup).camera, setup.sensor
    journal = Journal(RUN, (camera.height, camera.width), sensor.dtype, slots)
    live = Run(journal)
    live.go(frames)
    return live, journal


@pytest.mark.slow
@pytest.mark.parametrize(("kept_s", "slots", "count"), [(30.0, 40, 14), (0.45, 40, None), (30.0, 8, 8)])
def test_a_saved_window_replays_to_the_same_tracks(memory, tmp_path, kept_s, slots, count) -> None:
    live, journal = a_run(slots=slots)
    path = save_window(JournalReader(RUN), kept_s, live.jobs, 25.0, tmp_path / "saved", "asked")
    journal.close()
    saved = read_recording(path)
    assert count is None or len(saved.rows) == count
    assert len(saved.rows) >= 3
    replayed = replayed_tracks(saved)
    for seen, again in zip(live.tracks[-len(replayed) :], replayed, strict=True):
        np.testing.assert_equal(told(again), told(seen))
    assert sum(track.valid for track in replayed) >= 3
    assert json.loads((path / "black_box.json").read_text())["frames"] == len(saved.rows)
    assert (path / "live" / "results.csv").read_text().count("\n") == len(saved.rows) + 1


@pytest.mark.slow
def test_a_replay_shows_what_the_run_sent_and_why_it_refused(memory, tmp_path) -> None:
    live, journal = a_run()
    journal.write_status(refused(GateReason.CAMERA_STOPPED))
    path = save_window(JournalReader(RUN), 30.0, live.jobs, 25.0, tmp_path / "saved", "asked")
    journal.close()
    assert json.loads((path / "black_box.json").read_text())["gate_reason"] == "camera_stopped"
    replay = replay_recording(read_recording(path), tmp_path / "out")
    rows = list(csv.DictReader((tmp_path / "out" / "results.csv").read_text().splitlines()))
    run = [(row["run_validity"], row["run_gate_reason"], row["run_pose_doubt"]) for row in rows]
    assert run[6:11] == [
        ("valid", "", ""),
        ("held", "capture_too_old", ""),
        ("refused", "pose_implausible", "stopped"),
        ("valid", "", ""),
        ("not_sent", "", ""),
    ]
    assert [row["run_offset_y_mm"] for row in rows[6:9]] == ["0.60000", "0.70000", ""]
    names = ("offset_y_mm", "offset_z_mm", "validity")
    sent = [[row[name] for name in names] for row in rows]
    as_run = [[row[f"run_{name}"] for name in names] for row in rows]
    assert (rows[0]["validity"], rows[0]["gate_reason"]) == ("refused", "arc_off")
    differ = sum(one != other for one, other in zip(sent, as_run, strict=True))
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())["run_offsets"]
    assert (summary["frames"], summary["differ"]) == (14, differ)
    assert sum(kind["frames"] for kind in summary["differences"]) == differ > 0
    assert replay.warnings[-1].startswith(f"{differ} of 14 offsets are not those that the run sent: ")
    page = (tmp_path / "out" / "replay.html").read_text(encoding="utf-8")
    assert f"This is a black box: {differ} of 14 offsets" in page
    assert '"refused, pose_implausible, stopped"' in page


def test_a_run_that_is_replayed_alike_is_said_to_be() -> None:
    run = OffsetOutcome(0.1, math.nan, "valid", "soft_start")
    comparison = RunComparison()
    for other in (run, replace(run, offset_y_mm=0.1004, gate_reason=""), replace(run, pose_doubt="age")):
        comparison.add(run, other)
    assert str(comparison) == "all 3 offsets are those that the run sent"
    # An older black box notes no validity: its offsets are compared.
    comparison.add(OffsetOutcome(0.1, math.nan), replace(run, validity="held"))
    assert not comparison.differences
    comparison.add(run, replace(run, offset_z_mm=0.0))
    comparison.add(run, replace(run, offset_y_mm=0.102, validity="held"))
    by_replay = {"valid, soft_start": 1, "held, soft_start": 1}
    assert comparison.differences == {"valid, soft_start": by_replay}
    # finished.json keeps it.
    assert TypeAdapter(RunComparison).validate_json(json.dumps(asdict(comparison))) == comparison


@pytest.mark.parametrize("text", ["frame,offset_y_mm\n0,1\n", "frame,offset_y_mm,offset_z_mm\n0,a,1\n"])
def test_offsets_of_a_run_that_cannot_be_read_name_file_and_cure(tmp_path, text) -> None:
    assert read_run_offsets(tmp_path) == {}
    (tmp_path / "live").mkdir()
    (tmp_path / "live" / "results.csv").write_text(text)
    with pytest.raises(ArctrackError, match=r"live/results.csv: row 1: .*; take live/results.csv away"):
        read_run_offsets(tmp_path)


def test_a_state_comes_back_the_same(memory, tmp_path) -> None:
    live, journal = a_run(6)
    journal.close()
    path = tmp_path / "state.json"
    write_state(path, live.tracking.tracker.state)
    again = read_state(path)
    write_state(tmp_path / "again.json", again)
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()
    np.testing.assert_array_equal(again.history.stations_mm, live.tracking.tracker.state.history.stations_mm)
    assert again.history.displacements_mm.shape == live.tracking.tracker.state.history.displacements_mm.shape


def test_the_stretches_before_are_a_list_in_a_states_file(tmp_path) -> None:
    """As they were when a state held them so: a file of then is read, and one of now has its form."""
    state = SteppedState()
    histories = tuple(state.history.with_measurement(x_mm, (0.1, -0.2), (1e-4, 1e-4)) for x_mm in (3.0, 9.0))
    path = tmp_path / "state.json"
    write_state(path, state._replace(behind=histories))
    behind = json.loads(path.read_text())["state"]["behind"]
    assert [record["record"] for record in behind] == ["SeamHistory", "SeamHistory"]
    for again, history in zip(read_state(path).behind, histories, strict=True):
        np.testing.assert_equal(tuple(again), tuple(history))


def test_nothing_to_save_is_said(memory, tmp_path) -> None:
    journal = Journal(RUN, (6, 8), np.uint8, 8)
    with pytest.raises(ArctrackError, match="no frame was tracked yet"):
        save_window(JournalReader(RUN), 30.0, {}, 25.0, tmp_path / "saved", "asked")
    journal.close()


def status(**changes) -> Status:
    nothing = Status(
        0.0,
        0.0,
        Source.LIVE,
        TrackerState.TRACKING,
        Fault.NONE,
        LaserState.ON,
        GateReason.NONE,
        SeamOffset(0.0, 0.0, 1.0, 0.9, Validity.VALID),
        None,
        None,
        1,
        0,
        0,
        0,
    )
    return replace(nothing, **changes)


def refused(reason: GateReason) -> Status:
    return status(reason=reason, offset=SeamOffset(0.0, 0.0, 1.0, 0.9, Validity.REFUSED))


def test_a_fault_is_saved_once_and_what_is_commanded_is_none() -> None:
    watch = FaultWatch()
    assert watch.look(refused(GateReason.CAMERA_STOPPED)) is None
    assert watch.look(status()) is None
    assert watch.look(refused(GateReason.NOT_ARMED)) is None
    assert watch.look(status()) is None
    assert watch.look(refused(GateReason.CAMERA_STOPPED)) == "refused_camera_stopped"
    assert watch.look(refused(GateReason.CAMERA_STOPPED)) is None
    assert watch.look(status(fault=Fault.OTHER_TRACKER)) == "fault_other_tracker"
    assert watch.look(status(fault=Fault.OTHER_TRACKER)) is None


def test_a_request_during_a_save_is_covered_by_it() -> None:
    end, box = message_pipe()
    client = BlackBoxClient(end)
    assert client.answers() == []
    for _ in range(3):
        client.save("asked")
    assert box.recv() == {"save": "asked"}
    assert not box.poll()
    box.send({"saved": "here"})
    client.save("again")
    assert box.recv() == {"save": "again"}
    box.send({"error": "no frame was tracked yet"})
    assert client.answers() == ["black box: saved here", "black box: no frame was tracked yet"]
    assert client.answers() == []


@pytest.mark.slow
def test_a_fault_that_cannot_be_saved_is_told_and_saved_once_it_can(memory, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(recorder, "TRY_S", 0.05)
    monkeypatch.setattr(recorder, "AFTERMATH_S", 0.05)
    looks, look = SimpleQueue(), FaultWatch.look

    def told_look(watch, status):
        looks.put(status)
        return look(watch, status)

    monkeypatch.setattr(FaultWatch, "look", told_look)
    live, journal = a_run(5)
    boxes = tmp_path / "boxes"
    boxes.write_text("a file where the folder should be")
    told_end, its_end = multiprocessing.Pipe()
    options = RecorderOptions(RUN, boxes, 30.0, 25.0, live.jobs)
    thread = Thread(target=run_recorder, args=(options, its_end))
    thread.start()
    assert told_end.recv() == []
    problem = told_end.recv()
    assert problem == f"{boxes}: cannot be written: Not a directory"
    for shown in (status(), refused(GateReason.CAMERA_STOPPED)):
        journal.write_status(shown)
        # The recorder looks at it.
        while looks.get().offset != shown.offset:
            pass
    said: list[str] = []
    while not any(line.startswith("refused_camera_stopped is not saved: ") for line in said):
        said.append(told_end.recv())
    boxes.unlink()
    while said[-1] != "":
        said.append(told_end.recv())
    told_end.send(END)
    thread.join()
    journal.close()
    (saved,) = boxes.glob("*_refused_camera_stopped")
    assert len(read_recording(saved).rows) == 5


def test_a_folder_without_room_is_told(tmp_path) -> None:
    assert recorder.folder_problem(tmp_path / "not" / "there", 1000) == ""
    assert not (tmp_path / "not").exists()
    told = recorder.folder_problem(tmp_path, 2**60)
    assert re.fullmatch(rf"{tmp_path}: \d+ MB free, a black box takes up to 1152921504607 MB", told)


@pytest.mark.slow
def test_a_run_that_dies_leaves_its_last_frames(tmp_path) -> None:
    """The recorder is another process; the run's end of the connection closes without a word."""
    live, journal = a_run(5)
    spawn = multiprocessing.get_context("spawn")
    told_end, its_end = spawn.Pipe()
    options = RecorderOptions(RUN, tmp_path / "boxes", 30.0, 25.0, live.jobs)
    process = spawn.Process(target=run_recorder, args=(options, its_end))
    process.start()
    its_end.close()
    try:
        assert told_end.recv() == []
        told_end.send({"save": "a look / at it"})
        (saved,) = told_end.recv().values()
        assert Path(saved).name.endswith("_a_look___at_it")
        assert len(read_recording(saved).rows) == 5
        told_end.close()
        process.join(30.0)
        assert process.exitcode == 0
        (last,) = (tmp_path / "boxes").glob("*_run_ended_by_itself")
        assert len(read_recording(last).rows) == 5
    finally:
        process.kill()
        journal.close()


@pytest.mark.slow
def test_a_recording_that_is_played_fills_the_journal(memory, tmp_path) -> None:
    cell = read_cell_file(playing_cell(tmp_path / "cell", EXAMPLE))
    parts = run_parts(cell)
    setup = cell.setup.setup
    journal = Journal(
        RUN, (setup.camera.height, setup.camera.width), setup.sensor.dtype, slots_for(9.0, 25.0)
    )
    journal_writer = JournalWriter(journal)
    for seam in parts.seams.values():
        seam.tracking.tracker.warm_up()
    tracks: list[Track] = []
    with Link(channel=str(tmp_path), source=Source.REPLAY) as link:
        loop = LiveLoop(
            parts.camera,
            link,
            parts.controller,
            parts.seams,
            Source.REPLAY,
            lambda track, _: tracks.append(track),
            journal_writer,
        )
        result = run(loop, lambda: True, 60.0)
    jobs = {1: JobSetup(setup, job_setup_text(cell, 1))}
    path = save_window(JournalReader(RUN), 60.0, jobs, 25.0, tmp_path / "saved", "asked")
    assert JournalReader(RUN).status().frames in (result.frames, result.frames - 1, result.frames - 2)
    journal.close()
    # Frames that this machine was too late for are not there; the others replay the same.
    saved = read_recording(path)
    assert [row.index for row in saved.rows] == [track.frame for track in tracks]
    for again, seen in zip(replayed_tracks(saved), tracks, strict=True):
        np.testing.assert_equal(told(again), told(seen))
    # As a camera it gives them too.
    again: list[Track] = []
    parts = run_parts(read_cell_file(playing_cell(tmp_path / "again", path)))
    with Link(channel=str(tmp_path), source=Source.REPLAY) as link:
        run(
            LiveLoop(
                parts.camera,
                link,
                parts.controller,
                parts.seams,
                Source.REPLAY,
                lambda track, _: again.append(track),
            ),
            lambda: True,
            60.0,
        )
    # Up to the first frame that this machine was too late for.
    both = list(takewhile(lambda pair: pair[0].frame == pair[1].frame, zip(tracks, again, strict=False)))
    assert both
    for seen, other in both:
        np.testing.assert_equal(told(other), told(seen))
