"""Recordings replayed: read, tracked, judged; one at a time or many at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from arctrack.check.hint import Hint
from arctrack.check.seam_place import UNKNOWN_PLACE, SeamPlace
from arctrack.check.verdict import RunVerdict, verdict_on
from arctrack.errors import ArctrackError, in_file
from arctrack.finished import FinishedRecord, digest_of, sizes
from arctrack.fleet import FleetRow, FleetState, Number
from arctrack.offset_count import OffsetCount
from arctrack.output import folders_for, real
from arctrack.printable import printable
from arctrack.recording import Recording, read_recording
from arctrack.recording.results import FILES, REPLAY_PAGE, RESULTS_CSV, SUMMARY_JSON, Summary
from arctrack.replay.replay import RESULTS_FOLDER, ReplayOptions, parse_bus, replay_recording, track_alone
from arctrack.workers import FailedJob
from tracker.warm_up import WarmUp

NEEDED = (RESULTS_CSV, SUMMARY_JSON)
"""Files without which a replay is not whole."""


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


class ReplayRecord(FinishedRecord):
    """A finished replay: what `ReplayResult` says of it."""

    summaries: tuple[Summary, ...]
    verdict: FinishedVerdict
    replay_warnings: tuple[str, ...]
    complaint: str | None


def made_of(recording: Recording, options: ReplayOptions) -> str:
    """Return the digest of what a replay is made of.

    A cell's jobs count with the earlier pass and the weld schedule that they read.
    """
    cell = options.cell
    others = () if cell is None else (cell.path, *cell.files_read)
    return digest_of(recording, repr(replace(options, cell=None)), others)


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
    earlier = ReplayRecord.read(job.folder, digest, NEEDED, FILES) if job.resume else None
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
        files=dict(sizes(job.folder, FILES)),
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


FLEET_COLUMNS = {
    **dict.fromkeys(
        ("frames", "laser_on", "valid", "offsets_sent", "offsets_wanted", "beyond_limit"), "int64"
    ),
    **dict.fromkeys(("y_rms_mm", "z_rms_mm"), "float64"),
}
"""Numbers of a replay in a fleet's table, and Arrow's names for their types."""


def fleet_row(outcome: Outcome) -> FleetRow:
    """Return what came of a recording as a row of a fleet's table."""
    job = outcome.job
    if isinstance(outcome, FailedJob):
        return FleetRow(job.recording, job.folder, FleetState.FAILED, outcome.problem)
    summary = outcome.summaries[0]
    numbers: dict[str, Number] = {
        "frames": summary.frames,
        "laser_on": summary.laser_on,
        "valid": summary.valid,
        "offsets_sent": summary.offset_count.sent,
        "offsets_wanted": summary.offset_count.wanted,
    }
    if summary.score is not None:
        numbers["beyond_limit"] = summary.score.beyond_limit
        numbers["y_rms_mm"] = summary.score.lateral.whole.rms
        numbers["z_rms_mm"] = summary.score.vertical.whole.rms
    state = FleetState.TAKEN_OVER if outcome.is_taken_over else FleetState.DONE
    page = REPLAY_PAGE if job.options.pictures else ""
    share = summary.valid / summary.laser_on if summary.laser_on else 0.0
    return FleetRow(job.recording, job.folder, state, outcome.verdict.line, numbers, page, share)


def check_bus(options: ReplayOptions) -> None:
    """Raise ArctrackError where several replays at once would speak on one bus."""
    interface, _ = parse_bus(options.chosen_bus)
    if interface != "virtual":
        raise ArctrackError(
            f"--bus {options.chosen_bus}: a robot follows one replay at a time; leave --workers and "
            "--scheduler out"
        )
