"""The process that keeps a live run's black box: it saves the latest frames on a fault, or on request."""

import json
import math
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import IO

import numpy as np

from arctrack.errors import ArctrackError
from arctrack.live.journal.journal import JournalReader, remove_dead_journal
from arctrack.live.journal.message_pipe import PipeEnd
from arctrack.live.journal.records import NO_IMAGE, Entry, Status
from arctrack.offset_count import COMMANDED
from arctrack.recording.live_steps import write_steps
from arctrack.recording.results import ResultsWriter
from arctrack.recording.run_offsets import LIVE_FOLDER
from arctrack.recording.writer import RecordingWriter, VideoFormat
from noise_model.setup import Setup
from noise_model.transforms import pose_matrix
from robot_io import Fault, Validity

VERSIONS = ("arctrack", "numpy", "numba", "scipy", "opencv-contrib-python-headless")
"""Packages whose same versions give the same tracks."""


@dataclass(frozen=True)
class JobSetup:
    """A job's setup, and the text of the recording.toml that states it."""

    setup: Setup
    toml: str


def save_window(
    reader: JournalReader, kept_s: float, jobs: dict[int, JobSetup], rate_hz: float, path: Path, reason: str
) -> Path:
    """Save the latest `kept_s` of frames, as far back as one seam was tracked; return the recording.

    The oldest frames are read first, since the ring overwrites them first. They are copied to a file until
    all are read, and then compressed as a video that plays at `rate_hz`. Raises ArctrackError if no frame was
    tracked, or the recording cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=path.parent) as raw:
        entries = _read(reader, kept_s, raw)
        if not entries:
            raise ArctrackError("no frame was tracked yet")
        job = jobs[entries[-1].job_number]
        raw.seek(0)
        with RecordingWriter(path, job.setup, video=VideoFormat(rate_hz), toml=job.toml) as recording:
            (height, width), dtype = job.setup.frame_shape, job.setup.sensor.dtype
            for entry in entries:
                pixels = np.fromfile(raw, dtype, height * width)
                recording.write_frame(replace(entry.frame, image_dn=pixels.reshape(height, width)))
            for timestamp_s, T_base_tool in _poses(entries):
                recording.write_pose(timestamp_s, T_base_tool)
            folder = recording.unfinished_path
            write_steps(folder, ((entry.frame.index, entry.inputs) for entry in entries))
            _write_live(folder / LIVE_FOLDER, entries)
            (folder / "black_box.json").write_text(
                json.dumps(_about(entries, reason, reader.status()), indent=1), encoding="utf-8"
            )
    return path


def _read(reader: JournalReader, kept_s: float, raw: IO[bytes]) -> list[Entry]:
    """Return the window's entries without their images, which go into a file one after the other."""
    end = reader.count
    newest = reader.entry(end - 1) if end else None
    if newest is None:
        return []
    entries: list[Entry] = []
    for position in range(reader.first, end):
        entry = reader.entry(position)
        is_of_window = (
            entry is not None
            and entry.job_number == newest.job_number
            and newest.frame.timestamp_s - entry.frame.timestamp_s <= kept_s
        )
        if entry is None or not is_of_window:
            # What comes before is another seam's, or has a gap behind it.
            entries.clear()
            raw.seek(0)
            continue
        entry.frame.image_dn.tofile(raw)
        entries.append(replace(entry, frame=replace(entry.frame, image_dn=NO_IMAGE)))
    raw.flush()
    return entries


def _poses(entries: Sequence[Entry]) -> list[tuple[float, np.ndarray[tuple[int, int], np.dtype[np.float64]]]]:
    """Return the poses that the robot sent, by their times; those of the frames where it sent too few."""
    sent = {
        round(pose.sample.timestamp_s, 6): pose_matrix(
            pose.sample.position_base_mm, pose.sample.quaternion_xyzw
        )
        for entry in entries
        for pose in entry.poses
    }
    if len(sent) < 2:
        sent = {
            entry.frame.timestamp_s: entry.inputs.pose.T_base_tool
            for entry in entries
            if entry.inputs.pose is not None
        }
    return sorted(sent.items(), key=lambda pair: pair[0])


def _write_live(folder: Path, entries: Sequence[Entry]) -> None:
    """Write the tracks and offsets of the run, and when each pose was read."""
    folder.mkdir()
    with ResultsWriter(folder) as results:
        for entry in entries:
            results.write(entry.track, entry.outcome, entry.took_ms)
    with (folder / "poses_read.csv").open("w", encoding="utf-8") as file:
        file.write("timestamp_s,read_s\n")
        for entry in entries:
            for pose in entry.poses:
                file.write(f"{pose.sample.timestamp_s:.6f},{pose.read_s:.6f}\n")


def _about(entries: Sequence[Entry], reason: str, status: Status | None) -> dict[str, object]:
    first, last = entries[0], entries[-1]
    ended = (
        {}
        if status is None
        else {
            "state": status.state.name.lower(),
            "gate_reason": status.reason.name.lower(),
            "fault": status.fault.name.lower(),
        }
    )
    return {
        "reason": reason,
        **ended,
        "saved": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "job_number": last.job_number,
        "frames": len(entries),
        "dropped": last.dropped - first.dropped,
        "first_s": first.frame.timestamp_s,
        "last_s": last.frame.timestamp_s,
        "machine": platform.machine(),
        "python": platform.python_version(),
        "versions": {package: version(package) for package in VERSIONS},
    }


LOOK_S = 0.05
"""Period of reading the run's status, s: half of that of its writing."""

AFTERMATH_S = 2.0
"""Time from a fault to the end of its window, s: what followed is of interest too."""

MIN_BETWEEN_S, MAX_FAULTS_SAVED = 60.0, 20
"""Least time between two saved faults, and their largest number in a run: a fault that recurs fills no disk.
Requests are not counted.
"""

TRY_S = 10.0
"""Period of trying whether the folder can be written, s: three times before a fault's frames are gone."""

END = "end"
"""Message to a recorder whose run has ended as it should."""


@dataclass(frozen=True)
class RecorderOptions:
    """Options of a black box.

    `folder` takes the recordings, which reach back `kept_s`; their video plays at `rate_hz`. `jobs` has the
    setups by job number. With `saves_faults` a fault saves a recording too, not a request alone.
    """

    run: str
    folder: Path
    kept_s: float
    rate_hz: float
    jobs: Mapping[int, JobSetup]
    saves_faults: bool = True


class FaultWatch:
    """Says when a run's status shows a fault that nobody commanded."""

    def __init__(self) -> None:
        self._was_valid = False
        self._fault = Fault.NONE

    def look(self, status: Status) -> str | None:
        """Take the newest status, and return why its frames are to be saved; None while they are not."""
        before, self._fault = self._fault, status.fault
        was_valid = self._was_valid
        offset = status.offset
        self._was_valid = offset is not None and offset.validity is Validity.VALID
        if status.fault is not Fault.NONE:
            return f"fault_{status.fault.name.lower()}" if before is Fault.NONE else None
        is_refused = offset is not None and offset.validity is Validity.REFUSED
        if was_valid and is_refused and status.reason not in COMMANDED:
            return f"refused_{status.reason.name.lower()}"
        return None


def folder_problem(folder: Path, needed_bytes: int) -> str:
    """Return why a black box of some bytes could not be written into a folder; empty where it could."""
    # What is not there yet is made once something is saved.
    nearest = next((path for path in (folder, *folder.parents) if path.exists()), folder)
    try:
        with tempfile.TemporaryFile(dir=nearest) as file:
            file.write(bytes(1))
            file.flush()
        free_bytes = shutil.disk_usage(nearest).free
    except OSError as error:
        return f"{folder}: cannot be written: {error.strerror}"
    if free_bytes < needed_bytes:
        sizes = f"{free_bytes / 1e6:.0f} MB free, a black box takes up to {needed_bytes / 1e6:.0f} MB"
        return f"{folder}: {sizes}"
    return ""


def run_recorder(options: RecorderOptions, parent: Connection, *asked: PipeEnd) -> None:
    """Keep a run's black box until the parent ends it, or is gone.

    The parent is sent that it is ready, then what keeps it from saving, and "" once nothing does. Each
    connection of `asked` may send {"save": reason}, and is answered {"saved": path} or {"error": text}. Where
    the run's process ends without a message, its last frames are saved.
    """
    reader = JournalReader(options.run)
    parent.send([])
    recorder = _Recorder(options, reader, parent)
    open_ends: list[Connection | PipeEnd] = [parent, *asked]
    while True:
        ends = {end.fileno(): end for end in open_ends}
        for number in wait(ends, LOOK_S):
            assert isinstance(number, int)
            end = ends[number]
            try:
                message = end.recv()
            except (EOFError, OSError):
                open_ends.remove(end)
                if end is parent:
                    if options.saves_faults:
                        recorder.save_last("run_ended_by_itself")
                    remove_dead_journal(options.run)
                    return
                continue
            if message == END:
                recorder.finish()
                parent.close()
                return
            answer = recorder.save(str(message["save"]))
            with suppress(OSError):
                end.send(answer)
        recorder.try_folder()
        if options.saves_faults:
            recorder.look()


class _Recorder:
    def __init__(self, options: RecorderOptions, reader: JournalReader, parent: Connection) -> None:
        self._options, self._reader, self._parent = options, reader, parent
        self._watch = FaultWatch()
        self._due: tuple[float, str] | None = None
        self._forgotten_s = self._saved_s = float("-inf")
        self._faults_saved = 0
        self._tried_s, self._problem = float("-inf"), ""

    def try_folder(self) -> None:
        """Report whether a black box could be written now, where it is time to try."""
        now_s = time.monotonic()
        if now_s - self._tried_s >= TRY_S:
            self._tried_s = now_s
            setup = next(iter(self._options.jobs.values())).setup
            image_bytes = math.prod(setup.frame_shape) * np.dtype(setup.sensor.dtype).itemsize
            needed_bytes = round(self._options.kept_s * self._options.rate_hz * image_bytes)
            self._tell(folder_problem(self._options.folder, needed_bytes))

    def look(self) -> None:
        """Look at the run's status, and save what a fault has left once its aftermath is over."""
        status = self._reader.status()
        reason = None if status is None else self._watch.look(status)
        now_s = time.monotonic()
        is_rare = now_s - self._saved_s > MIN_BETWEEN_S and self._faults_saved < MAX_FAULTS_SAVED
        if reason is not None and self._due is None and is_rare:
            self._due = (now_s + AFTERMATH_S, reason)
            self._forgotten_s = now_s + self._options.kept_s
        if self._due is not None and now_s >= self._due[0]:
            self.finish()

    def finish(self) -> None:
        """Save what waits for its aftermath; where it cannot be written, again while its frames are there."""
        if self._due is None:
            return
        _, reason = self._due
        answer, now_s = self.save(reason), time.monotonic()
        if "saved" in answer:
            self._faults_saved += 1
        else:
            self._tell(f"{reason} is not saved: {answer['error']}")
        is_over = "saved" in answer or now_s + TRY_S > self._forgotten_s
        self._due = None if is_over else (now_s + TRY_S, reason)
        self._tried_s = now_s

    def save_last(self, reason: str) -> None:
        """Save the window of a run that is gone."""
        self._due = (0.0, reason)
        self.finish()

    def save(self, reason: str) -> dict[str, str]:
        """Save the window, and return the answer to the request."""
        options = self._options
        name = "".join(letter if letter.isalnum() else "_" for letter in reason)[:60]
        path = options.folder / f"{time.strftime('%Y-%m-%dT%H-%M-%S')}_{name}"
        self._saved_s = time.monotonic()
        try:
            save_window(self._reader, options.kept_s, dict(options.jobs), options.rate_hz, path, reason)
        except (ArctrackError, OSError) as error:
            return {"error": str(error)}
        return {"saved": str(path)}

    def _tell(self, problem: str) -> None:
        """Report what keeps a black box from being written; on stderr where the run has ended."""
        if problem == self._problem:
            return
        self._problem = problem
        try:
            self._parent.send(problem)
        except OSError:
            with suppress(OSError):
                print(f"arctrack: warning: black box: {problem}", file=sys.stderr, flush=True)
