"""A window of a run's journal as a recording: frames, poses, steps, and what the run made of them."""

import json
import platform
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import IO

import numpy as np

from arctrack.errors import ArctrackError
from arctrack.live.journal.journal import JournalReader
from arctrack.live.journal.records import NO_IMAGE, Entry, Status
from arctrack.recording.live_steps import write_steps
from arctrack.recording.results import ResultsWriter
from arctrack.recording.run_offsets import LIVE_FOLDER
from arctrack.recording.writer import RecordingWriter, VideoFormat
from noise_model.setup import Setup
from noise_model.transforms import pose_matrix

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
            height, width, dtype = job.setup.camera.height, job.setup.camera.width, job.setup.sensor.dtype
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
