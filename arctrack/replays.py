"""Recordings replayed: read, tracked, judged; one at a time or many at once."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

import arctrack
from arctrack.check.hint import Hint
from arctrack.check.seam_place import UNKNOWN_PLACE, SeamPlace
from arctrack.check.verdict import RunVerdict, verdict_on
from arctrack.errors import ArctrackError, in_file
from arctrack.limits import LIMITS
from arctrack.offset_count import OffsetCount
from arctrack.output import folders_for, real, write_whole
from arctrack.printable import printable
from arctrack.recording import Recording, read_recording
from arctrack.recording.files import FRAMES_CSV, TRUTH_CSV, read_text
from arctrack.recording.frames import png_path
from arctrack.recording.live_steps import STATE_JSON, STEPS_CSV
from arctrack.recording.poses import CSV_NAME, LOG_NAMES
from arctrack.recording.results import FILES, FINISHED_JSON, RESULTS_CSV, SUMMARY_JSON, Summary
from arctrack.recording.run_offsets import LIVE_FOLDER, LIVE_RESULTS
from arctrack.replay.replay import RESULTS_FOLDER, ReplayOptions, parse_bus, replay_recording, track_alone
from arctrack.version import __version__
from arctrack.workers import FailedJob
from tracker.warm_up import WarmUp

LIVE_TABLE = f"{LIVE_FOLDER}/{LIVE_RESULTS}"

TABLES = (FRAMES_CSV, TRUTH_CSV, CSV_NAME, *LOG_NAMES, STEPS_CSV, STATE_JSON, LIVE_TABLE)
"""The files of a recording that are compared by content."""


class FinishedVerdict(BaseModel):
    """A `RunVerdict`, its hint as what is wrong, the cure and the probability."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    frames: int
    laser_on: int
    valid: int
    flags: dict[str, int]
    hint: tuple[str, str, float] | None
    offsets: OffsetCount
    reasons: dict[str, int]
    seam_mm: tuple[float, float] | None

    @classmethod
    def of(cls, verdict: RunVerdict) -> FinishedVerdict:
        """Return a verdict's record."""
        hint = verdict.hint
        return cls(
            frames=verdict.frames,
            laser_on=verdict.laser_on,
            valid=verdict.valid,
            flags=dict(verdict.flags),
            hint=None if hint is None else (hint.what, hint.cure, hint.probability),
            offsets=verdict.offsets,
            reasons=dict(verdict.reasons),
            seam_mm=None if math.isnan(verdict.seam.y_mm) else (verdict.seam.y_mm, verdict.seam.z_mm),
        )

    def verdict(self) -> RunVerdict:
        """Return the verdict."""
        hint = None if self.hint is None else Hint(*self.hint)
        counts = self.frames, self.laser_on, self.valid, self.flags
        seam = UNKNOWN_PLACE if self.seam_mm is None else SeamPlace(*self.seam_mm)
        return RunVerdict(*counts, hint, self.offsets, self.reasons, seam)


class ReplayRecord(BaseModel):
    """Content of finished.json: the digest of the inputs, the sizes in bytes of the output files.

    The rest is what `ReplayResult` says of the replay.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["arctrack-finished/1"] = "arctrack-finished/1"
    made_of: str
    files: dict[str, int]
    summaries: tuple[Summary, ...]
    verdict: FinishedVerdict
    replay_warnings: tuple[str, ...]
    complaint: str | None

    def write(self, folder: Path) -> None:
        """Write finished.json, whole or not at all; ArctrackError if it cannot be written."""
        write_whole(folder / FINISHED_JSON, json.dumps(self.model_dump(), indent=2) + "\n")


def read_finished(folder: Path, made_of: str) -> ReplayRecord | None:
    """Return the result of a folder's finished replay; None unless it is whole, and was made of the same."""
    try:
        finished = ReplayRecord.model_validate(
            json.loads(read_text(folder / FINISHED_JSON, LIMITS.toml_bytes))
        )
    except (OSError, ValueError):
        return None
    whole = {RESULTS_CSV, SUMMARY_JSON} <= finished.files.keys() and finished.files == sizes(folder)
    return finished if whole and finished.made_of == made_of else None


def sizes(folder: Path) -> Mapping[str, int]:
    """Return the size of each file in a folder that a replay wrote, in bytes."""
    paths = ((name, folder / name) for name in FILES if name != FINISHED_JSON)
    return {name: path.stat().st_size for name, path in paths if path.is_file()}


def made_of(recording: Recording, options: ReplayOptions) -> str:
    """Return the digest of what a replay is made of: recording, setup, options, cell file, arctrack itself.

    A cell's jobs count with the earlier pass and the weld schedule that they read.

    Tables and setups count by content, frames by name, size and time of change: a fleet's are too many to
    read twice.
    """
    digest = hashlib.sha256()
    cell = options.cell
    for part in (
        __version__,
        source_digest(),
        recording.name,
        repr(replace(options, cell=None)),
        *_contents(recording, () if cell is None else (cell.path, *cell.files_read)),
        *_frames(recording),
    ):
        digest.update(hashlib.sha256(part.encode(errors="surrogateescape")).digest())
    return digest.hexdigest()


def _contents(recording: Recording, others: tuple[Path, ...]) -> Iterator[str]:
    for path in (recording.setup_path, *others, *(recording.path / name for name in TABLES)):
        is_there = path.is_file()
        yield hashlib.sha256(path.read_bytes()).hexdigest() if is_there else "none"


def _frames(recording: Recording) -> Iterator[str]:
    source = recording.frame_source
    paths = [png_path(source, row.index) for row in recording.rows] if source.is_dir() else [source]
    for path in paths:
        status = path.stat() if path.exists() else None
        yield f"{path.name} none" if status is None else f"{path.name} {status.st_size} {status.st_mtime_ns}"


@cache
def source_digest() -> str:
    """Return the digest of arctrack's own sources: a version of its own for each change of them."""
    digest = hashlib.sha256()
    root = real(Path(arctrack.__file__)).parent.parent
    # A replay's numbers depend on these packages.
    for package in ("arctrack", "noise_model", "robot_io", "tracker"):
        for path in sorted((root / package).rglob("*.py")):
            digest.update(
                f"{path.relative_to(root)} {hashlib.sha256(path.read_bytes()).hexdigest()}".encode()
            )
    return digest.hexdigest()


OnFrame = Callable[[int], None]
"""Callback with the number of frames done."""


@dataclass(frozen=True)
class ReplayJob:
    """One recording to replay: folder of its files, another setup than its own, and options.

    `resume` takes over what an earlier run of the same finished there. `cores` are there for its pictures.
    """

    recording: Path
    folder: Path
    setup_path: Path | None = None
    options: ReplayOptions = field(default_factory=ReplayOptions)
    resume: bool = False
    cores: int = 1

    @property
    def name(self) -> str:
        """The recording's name, fit to print."""
        return printable(real(self.recording).name)

    def absolute(self) -> ReplayJob:
        """Return the job for a process elsewhere, which has its own working directory."""
        setup_path = None if self.setup_path is None else self.setup_path.absolute()
        recording, folder = self.recording.absolute(), self.folder.absolute()
        return replace(self, recording=recording, folder=folder, setup_path=setup_path)


@dataclass(frozen=True)
class Listeners:
    """Progress callbacks of a replay: frames, pictures, what is compiled, frames of the second replay."""

    on_frame: OnFrame | None = None
    on_drawn: OnFrame | None = None
    on_compared: OnFrame | None = None


@dataclass(frozen=True, eq=False)
class ReplayResult:
    """A recording after its replay, small enough to hand from process to process.

    `summaries` has a second one where the replay went without the arc map and the truth is known: that with
    it. `warnings` are of the recording's tables, `replay_warnings` of the replay, one line each. `complaint`
    is one line on frames that could not be read, None if all could. `is_taken_over` says that an earlier run
    did it.
    """

    job: ReplayJob
    summaries: tuple[Summary, ...]
    verdict: RunVerdict
    warnings: tuple[str, ...]
    replay_warnings: tuple[str, ...]
    complaint: str | None
    warm_up: WarmUp
    is_taken_over: bool = False


Outcome = ReplayResult | FailedJob[ReplayJob]


def jobs_for(
    recordings: Sequence[Path],
    out: Path | None = None,
    setup_path: Path | None = None,
    options: ReplayOptions | None = None,
    resume: bool = False,
    cores: int = 1,
) -> list[ReplayJob]:
    """Return the replays to run; ArctrackError if two would share a folder of results, or a seam's file."""
    folders = folders_for(recordings, out, RESULTS_FOLDER, "its results would replace others")
    options = options or ReplayOptions()
    if options.cell is not None and len(recordings) > 1:
        number = options.cell.job_numbered(options.job_number)
        if options.cell.jobs[number].keep_seam is not None:
            raise in_file(
                options.cell.path,
                f"[jobs.{number}] keep_seam: keeps one recording's seam; replay one at a time",
            )
    return [
        ReplayJob(path, folder, setup_path, options, resume, cores)
        for path, folder in zip(recordings, folders, strict=True)
    ]


def replay_job(job: ReplayJob, begin: Callable[[Recording], Listeners] | None = None) -> ReplayResult:
    """Replay a recording and write its results; `begin` returns the progress callbacks, once it is read.

    Raises ArctrackError for what the user can mend.
    """
    recording = read_recording(job.recording, job.setup_path)
    digest = made_of(recording, job.options)
    earlier = read_finished(job.folder, digest) if job.resume else None
    if earlier is not None:
        return _taken_over(job, recording, earlier)
    listeners = Listeners() if begin is None else begin(recording)
    done = replay_recording(
        recording, job.folder, job.options, listeners.on_frame, listeners.on_drawn, cores=job.cores
    )
    summaries = [done.summary]
    if not job.options.use_arc_map and done.recording.has_truth:
        summaries.append(track_alone(done.recording, True, listeners.on_compared))
    verdict = verdict_on(done.recording, done.tracks, done.summary)
    warnings = [*done.warnings, *filter(None, [verdict.seam_warning])]
    replayed = ReplayResult(
        job,
        tuple(summaries),
        verdict,
        recording.warnings,
        tuple(f"{recording.path}: {warning}" for warning in warnings),
        done.complaint,
        done.warm_up,
    )
    # Last of all, when pictures and logs are closed: what is not there by then was not finished.
    ReplayRecord(
        made_of=digest,
        files=dict(sizes(job.folder)),
        summaries=replayed.summaries,
        verdict=FinishedVerdict.of(replayed.verdict),
        replay_warnings=replayed.replay_warnings,
        complaint=replayed.complaint,
    ).write(job.folder)
    return replayed


def _taken_over(job: ReplayJob, recording: Recording, earlier: ReplayRecord) -> ReplayResult:
    return ReplayResult(
        job,
        earlier.summaries,
        earlier.verdict.verdict(),
        recording.warnings,
        earlier.replay_warnings,
        earlier.complaint,
        WarmUp(0, 0.0),
        is_taken_over=True,
    )


def check_bus(options: ReplayOptions) -> None:
    """Raise ArctrackError where several replays at once would speak on one bus."""
    interface, _ = parse_bus(options.chosen_bus)
    if interface != "virtual":
        raise ArctrackError(
            f"--bus {options.chosen_bus}: a robot follows one replay at a time; leave --workers and "
            "--scheduler out"
        )
