"""`arctrack diagnose`: is there a gap between recording and model, which effect is it, what to do."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.inputs import look_at_recordings
from arctrack.cli.options import Fleet, Resume, Scheduler, Workers
from arctrack.errors import ArctrackError

if TYPE_CHECKING:
    from rich.progress import Progress

    from arctrack.diagnose.diagnose import DiagnosisJob, DiagnosisResult, OnStage, Outcome
    from arctrack.recording import Recording


def diagnose(
    recordings: Annotated[list[Path], typer.Argument(help="Folders that hold a recording each.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Where files go; default: diagnosis/ in the recording. A folder each for several."),
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option(metavar="EFFECT", help="Leave an effect out of the search; repeat it for more."),
    ] = None,
    setup: Annotated[
        Path | None, typer.Option(help="A recording.toml to use instead of each recording's own.")
    ] = None,
    apply: Annotated[
        bool, typer.Option("--apply", help="Write the effects that were found into recording.toml.")
    ] = False,
    on: Annotated[
        Path | None,
        typer.Option(
            metavar="RECORDING",
            help="Another recording of the same cell: how far the effects that were found close its gap.",
        ),
    ] = None,
    resume: Resume = False,
    fleet: Fleet = None,
    workers: Workers = 1,
    scheduler: Scheduler = None,
) -> None:
    """Compare recordings with the model: is there a gap, where, which effect causes it, how far it closes.

    Writes report.html, report.json, where.npz and predicted.npz. With --apply or --on it also writes
    applied.html, applied.json and applied.npz: the gap without and with the effects, on frames that no fit
    saw. Frames whose arc is on need the setup's tables of arc, filter and material; a plain laser's need none
    of them. A recording that fails does not stop the others; the exit code is then 2.
    """
    if on is not None and len(recordings) > 1:
        raise ArctrackError("--on tries the effects of one recording: diagnose one at a time")
    if resume and (apply or on is not None):
        raise ArctrackError("--resume takes over reports alone: leave it out with --apply and --on")
    look_at_recordings(recordings if on is None else [*recordings, on], setup)
    from arctrack.cli import console
    from arctrack.cli.diagnose_text import print_many, print_one
    from arctrack.diagnose.diagnose import FLEET_COLUMNS, DiagnosisResult, fleet_row, jobs_for, summary_of
    from arctrack.fleet import followed
    from arctrack.workers import FailedJob, check_choice

    if apply and setup is not None:
        raise ArctrackError("--apply writes into the recording's own recording.toml: leave --setup out")
    check_choice(workers, scheduler)
    jobs = jobs_for(recordings, out, setup, without or (), resume)
    other = None if on is None else _other(jobs[0], on)
    outcomes = []
    with followed(fleet, "diagnosis", len(jobs), FLEET_COLUMNS) as on_row:
        for outcome in _outcomes(jobs, workers, scheduler):
            on_row(fleet_row(outcome))
            outcomes.append(outcome)
    places = {job.folder: n for n, job in enumerate(jobs)}
    outcomes.sort(key=lambda outcome: places[outcome.job.folder])
    failed = [outcome for outcome in outcomes if isinstance(outcome, FailedJob)]
    done = [outcome for outcome in outcomes if not isinstance(outcome, FailedJob)]
    diagnosed = [outcome for outcome in done if isinstance(outcome, DiagnosisResult)]
    if len(jobs) == len(diagnosed) == 1:
        print_one(diagnosed)
    elif done:
        print_many(done)
    told = [summary_of(outcome).complaint for outcome in done]
    complaints = [*(failure.problem for failure in failed), *filter(None, told)]
    complaints += _add_effects(diagnosed, apply, other)
    console.complain(complaints)
    for failure in failed:
        if not failure.foreseen:
            raise failure.error
    if complaints:
        from arctrack.cli.exit_codes import BAD_INPUT

        raise typer.Exit(BAD_INPUT)


def _outcomes(jobs: list[DiagnosisJob], workers: int, scheduler: str | None) -> Iterator[Outcome]:
    from arctrack.diagnose import diagnose as engine
    from arctrack.workers import executor_of

    with _progress() as bar:
        if scheduler is None and min(workers, len(jobs)) == 1:
            yield from engine.in_turn(jobs, lambda job: _stages(bar, job.name))
            return
        task = bar.add_task("recordings", total=len(jobs))
        with executor_of(min(workers, len(jobs)), scheduler) as executor:
            for outcome in engine.at_once(jobs, executor):
                bar.advance(task)
                yield outcome


def _other(job: DiagnosisJob, on: Path) -> Recording:
    from arctrack.diagnose.applied import other_recording

    return other_recording(job, on)


def _add_effects(done: list[DiagnosisResult], is_written: bool, other: Recording | None) -> list[str]:
    """Write what was found into each recording, and print how far it closes the gap of frames held out.

    Returns a line for each recording where nothing was added.
    """
    from arctrack.cli import console
    from arctrack.cli.diagnose_text import print_applied
    from arctrack.diagnose.applied import apply_to_other, apply_to_own, write_applied
    from arctrack.diagnose.diagnose import apply, named_effects

    complaints = []
    for diagnosed in done:
        try:
            is_named = bool(named_effects(diagnosed.diagnosis))
            if is_written and (is_named or other is None):
                console.say(apply(diagnosed))
            if other is not None:
                with _progress() as bar:
                    applied = apply_to_other(diagnosed, other, _stages(bar, other.name))
            elif is_written and is_named:
                applied = apply_to_own(diagnosed)
            else:
                continue
            write_applied(applied)
            print_applied(applied)
        except ArctrackError as error:
            complaints.append(str(error))
    return complaints


def _progress() -> Progress:
    """Return a bar over stages with the time that they took, on stderr."""
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn

    from arctrack.cli.console import SpokenProgress

    return SpokenProgress(
        TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeElapsedColumn()
    )


def _stages(bar: Progress, name: str) -> OnStage:
    task = bar.add_task(name, total=1.0)

    def on_stage(stage: str, share_done: float) -> None:
        bar.update(task, description=f"{name}: {stage}", completed=share_done)

    return on_stage
