"""Recordings replayed: read, tracked, judged; one at a time or many at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from arctrack.check.verdict import RunVerdict, verdict_on
from arctrack.errors import ArctrackError
from arctrack.finished_replay import FinishedVerdict, ReplayRecord, made_of, read_finished, sizes
from arctrack.output import folders_for, real
from arctrack.printable import printable
from arctrack.recording import Recording, read_recording
from arctrack.recording.results import Summary
from arctrack.replay.replay import RESULTS_FOLDER, ReplayOptions, parse_bus, replay_recording, track_alone
from arctrack.workers import FailedJob
from tracker.warm_up import WarmUp

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
    """Return the replays to run; ArctrackError if two recordings would share a folder of results."""
    folders = folders_for(recordings, out, RESULTS_FOLDER, "its results would replace others")
    return [
        ReplayJob(path, folder, setup_path, options or ReplayOptions(), resume, cores)
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
