"""Recordings diagnosed: read, compared with the model, written down; one at a time or many at once."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from arctrack import workers
from arctrack.diagnose.diagnosis_files import ADDED_FILES, FILES, MADE_FILES, REPORT_PAGE, write_numbers
from arctrack.diagnose.pages import words
from arctrack.errors import ArctrackError, in_file
from arctrack.finished import FinishedRecord, digest_of, sizes
from arctrack.fleet import FleetRow, FleetState, Number
from arctrack.output import folders_for, make_folder, real, write_whole
from arctrack.printable import printable
from arctrack.recording import pose_at, read_recording, require_images
from arctrack.recording.setup_file import with_effects
from arctrack.recording.setup_writer import FILE_NAME
from arctrack.workers import FailedJob
from noise_model.effects import REGISTRY
from noise_model.setup import Setup
from noise_model.spelling import cure_for
from sim_to_real.diagnosis import Diagnosis, DiagnosisVerdict, HeldOutPrediction, NamedEffect

THREADS = 2
"""Threads of a recording that is diagnosed alone; with other processes one is best."""

OnStage = Callable[[str, float], None]
"""Callback with a diagnosis' activity, and the share of it that is done."""


@dataclass(frozen=True)
class DiagnosisJob:
    """One recording to diagnose: folder of its files, another setup than its own, effects left out.

    `resume` takes over what an earlier run of the same finished there.
    """

    recording: Path
    folder: Path
    setup_path: Path | None = None
    without: tuple[str, ...] = ()
    resume: bool = False

    @property
    def name(self) -> str:
        """The recording's name, fit to print."""
        return printable(real(self.recording).name)


@dataclass(frozen=True, eq=False)
class DiagnosisResult:
    """A recording after its diagnosis, which comes without its images: those are in the folder.

    `setup` is the one that the recording's `n_frames` were held against; `complaint` is one line on frames
    that could not be read, None if all could.
    """

    job: DiagnosisJob
    setup: Setup
    n_frames: int
    diagnosis: Diagnosis
    warnings: tuple[str, ...]
    complaint: str | None


@dataclass(frozen=True)
class DiagnosisSummary:
    """A diagnosis in a line of a table; NaN is not known.

    `named` are its effects in words, `withheld` what the user left out. `confidence` is that of the first
    effect, `p_value` that of the model.
    """

    verdict: str
    named: str
    before: float
    after: float
    closed: float
    confidence: float
    p_value: float
    withheld: str
    warnings: tuple[str, ...]
    complaint: str | None


class DiagnosisRecord(FinishedRecord):
    """A finished diagnosis."""

    summary: DiagnosisSummary


@dataclass(frozen=True)
class TakenOver:
    """A recording whose diagnosis an earlier run has finished."""

    job: DiagnosisJob
    summary: DiagnosisSummary


Outcome = DiagnosisResult | TakenOver | FailedJob[DiagnosisJob]

FLEET_COLUMNS = {
    **dict.fromkeys(("verdict", "effects"), "string"),
    **dict.fromkeys(("confidence", "p_value", "gap_before", "gap_after", "gap_closed"), "float64"),
}
"""Numbers of a diagnosis in a fleet's table, and Arrow's names for their types."""


def jobs_for(
    recordings: Sequence[Path],
    out: Path | None = None,
    setup_path: Path | None = None,
    without: Sequence[str] = (),
    resume: bool = False,
) -> list[DiagnosisJob]:
    """Return the diagnoses to run; ArctrackError for an unknown effect and for folders that would be shared.

    Paths come out absolute: a process elsewhere has its own working directory.
    """
    for name in without:
        if name not in REGISTRY:
            raise ArctrackError(f"--without {name}: there is no such effect; {cure_for(name, REGISTRY)}")
    setup = None if setup_path is None else setup_path.absolute()
    paths = [recording.absolute() for recording in recordings]
    where = None if out is None else out.absolute()
    folders = folders_for(paths, where, "diagnosis", "its diagnosis would replace another")
    return [
        DiagnosisJob(path, folder, setup, tuple(without), resume)
        for path, folder in zip(paths, folders, strict=True)
    ]


def diagnose_recording(
    job: DiagnosisJob, on_stage: OnStage | None = None, threads: int = THREADS
) -> DiagnosisResult | TakenOver:
    """Diagnose a recording and write report.json, where.npz, predicted.npz, report.html and finished.json.

    Frames are predicted on `threads` threads. Raises ArctrackError for what the user can mend.
    """
    from arctrack.diagnose.pages.page import write_page
    from sim_to_real.diagnose import diagnose

    recording = read_recording(job.recording, job.setup_path)
    require_images(recording.setup, recording.setup_path, "arctrack check asks a profiler's recording")
    made_of = digest_of(recording, repr(job.without))
    if job.resume:
        earlier = DiagnosisRecord.read(job.folder, made_of, MADE_FILES, FILES)
        if earlier is not None:
            return TakenOver(job, earlier.summary)
    make_folder(job.folder, FILES + ADDED_FILES)
    frames, bad_frames = recording.readable_frames()
    poses = recording.pose_buffer()
    try:
        # The clock's delay is the diagnosis' to find: poses are those of the time it asks for.
        result = diagnose(
            recording.setup,
            frames,
            lambda timestamp_s: pose_at(poses, timestamp_s),
            without=job.without,
            on_stage=on_stage,
            threads=threads,
        )
    except ValueError as error:
        raise in_file(job.recording, str(error)) from error
    # Numbers first: whatever happens to the page, the work is not lost.
    write_numbers(result, job.folder, job.without)
    write_page(result, recording, job.without, job.folder / REPORT_PAGE)
    diagnosed = DiagnosisResult(
        job,
        recording.setup,
        len(frames),
        without_images(result),
        recording.warnings,
        recording.complaint(bad_frames, "the diagnosis is that of the others"),
    )
    # Last of all: what is not there by then was not finished.
    files = dict(sizes(job.folder, FILES))
    DiagnosisRecord(made_of=made_of, files=files, summary=summary_of(diagnosed)).write(job.folder)
    return diagnosed


def summary_of(diagnosed: DiagnosisResult | TakenOver) -> DiagnosisSummary:
    """Return a diagnosis in a line of a table."""
    if isinstance(diagnosed, TakenOver):
        return diagnosed.summary
    diagnosis, gap = diagnosed.diagnosis, diagnosed.diagnosis.gap
    return DiagnosisSummary(
        verdict=diagnosis.verdict.value,
        named=words.named(diagnosis),
        before=gap.before,
        after=gap.after,
        closed=gap.closed,
        confidence=diagnosis.effects[0].confidence if diagnosis.effects else math.nan,
        p_value=diagnosis.model_test.p_value,
        withheld=words.withheld(diagnosis, diagnosed.job.without),
        warnings=diagnosed.warnings,
        complaint=diagnosed.complaint,
    )


def fleet_row(outcome: Outcome) -> FleetRow:
    """Return what came of a recording as a row of a fleet's table."""
    job = outcome.job
    if isinstance(outcome, FailedJob):
        return FleetRow(job.recording, job.folder, FleetState.FAILED, outcome.problem)
    summary = summary_of(outcome)
    numbers: dict[str, Number] = {
        "verdict": summary.verdict,
        "effects": summary.named,
        "confidence": summary.confidence,
        "p_value": summary.p_value,
        "gap_before": summary.before,
        "gap_after": summary.after,
        "gap_closed": summary.closed,
    }
    known = {name: value for name, value in numbers.items() if not _is_unknown(value)}
    state = FleetState.TAKEN_OVER if isinstance(outcome, TakenOver) else FleetState.DONE
    said = summary.complaint or ""
    return FleetRow(job.recording, job.folder, state, said, known, REPORT_PAGE, summary.p_value)


def _is_unknown(value: Number) -> bool:
    return isinstance(value, float) and math.isnan(value)


def in_turn(jobs: Iterable[DiagnosisJob], on_stage: Callable[[DiagnosisJob], OnStage]) -> Iterator[Outcome]:
    """Diagnose recordings one after another in this process; one that fails does not stop the others."""
    for job in jobs:
        try:
            yield diagnose_recording(job, on_stage(job))
        except Exception as error:
            yield FailedJob(job, error)


def at_once(jobs: Iterable[DiagnosisJob], executor: Executor) -> Iterator[Outcome]:
    """Diagnose recordings wherever an executor runs them, and yield each as it comes."""
    return workers.at_once(partial(diagnose_recording, threads=1), jobs, executor)


def apply(diagnosed: DiagnosisResult) -> str:
    """Write the effects that a verdict names into the recording's recording.toml; return a note of it.

    The file is replaced at once, or not at all. ArctrackError, and nothing is written, if the verdict is
    that the recording cannot say which effect it is, or that none fits.
    """
    job, diagnosis = diagnosed.job, diagnosed.diagnosis
    path = job.recording / FILE_NAME
    if diagnosis.verdict is DiagnosisVerdict.NO_GAP:
        return f"{path}: no gap, so there is nothing to write"
    effects = named_effects(diagnosis)
    if not effects:
        raise in_file(
            path,
            f"nothing was written: --apply writes effects that a verdict names, this one is "
            f"{diagnosis.verdict.value!r}",
        )
    write_whole(path, with_effects(path, effects))
    return f"{path}: wrote {', '.join(map(_table, effects))}"


def named_effects(diagnosis: Diagnosis) -> tuple[NamedEffect, ...]:
    """Return the effects that a verdict is sure of: those alone may be added to a setup."""
    return diagnosis.effects if diagnosis.verdict is DiagnosisVerdict.EFFECTS else ()


def without_images(diagnosis: Diagnosis) -> Diagnosis:
    """Return a diagnosis that is small enough to hand from process to process."""
    none = np.empty((0, 0, 0), dtype=np.float32)
    predicted = HeldOutPrediction(
        diagnosis.predicted.frames, np.empty((0, 0, 0), dtype=np.uint8), none, none, none, none
    )
    where = replace(diagnosis.where, z=np.empty((0, 0), dtype=np.float32))
    return replace(diagnosis, where=where, predicted=predicted)


def _table(effect: NamedEffect) -> str:
    values = ", ".join(f"{name} = {estimate.value:.6g}" for name, estimate in effect.parameters.items())
    return f"[effects.{effect.id}] {values}"
