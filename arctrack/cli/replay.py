"""`arctrack replay`: recordings in, offsets on the bus and results out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.inputs import look_at_cell, look_at_recordings
from arctrack.cli.interrupt import interruptible
from arctrack.cli.options import ArcMap, Fleet, Resume, Scheduler, Workers
from arctrack.errors import ArctrackError

if TYPE_CHECKING:
    from rich.progress import Progress

    from arctrack.check.verdict import RunVerdict
    from arctrack.recording import Recording
    from arctrack.replays import Listeners, Outcome, ReplayJob, ReplayResult


def replay(
    recordings: Annotated[list[Path], typer.Argument(help="Folders that hold a recording each.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Where results go; default: results/ in the recording. A folder each for several."),
    ] = None,
    setup: Annotated[
        Path | None, typer.Option(help="A recording.toml to use instead of each recording's own.")
    ] = None,
    cell: Annotated[
        Path | None,
        typer.Option(help="A cell.toml: its bus, gate limits and job instead of what the setup follows by."),
    ] = None,
    job: Annotated[int | None, typer.Option(help="The job of the cell file, by its number.")] = None,
    bus: Annotated[
        str | None,
        typer.Option(
            help="CAN bus for the offsets, python-can's interface:channel; default: the cell file's, else "
            "virtual:arctrack."
        ),
    ] = None,
    onto_a_robot: Annotated[
        bool,
        typer.Option(
            "--onto-a-robot",
            help="Allow a bus other than virtual: a robot may listen there. It must stand where the "
            "recording's robot stood, and what it hears is marked as a replay.",
        ),
    ] = False,
    arc_map: ArcMap = True,
    pictures: Annotated[
        bool,
        typer.Option(
            "--pictures/--no-pictures",
            help="--pictures writes overlay.mp4, overview.png, replay.html; --no-pictures leaves them out.",
        ),
    ] = True,
    mcap: Annotated[
        bool, typer.Option("--mcap", help="Write replay.mcap too, for Foxglove. Needs arctrack\\[mcap].")
    ] = False,
    rrd: Annotated[
        bool, typer.Option("--rrd", help="Write replay.rrd too, for Rerun. Needs arctrack\\[rerun].")
    ] = False,
    resume: Resume = False,
    parquet: Annotated[
        Path | None,
        typer.Option(
            help="Write the frames of all recordings into one Parquet file too. Needs arctrack\\[parquet]."
        ),
    ] = None,
    fleet: Fleet = None,
    workers: Workers = 1,
    scheduler: Scheduler = None,
) -> None:
    """Track recordings; write results.csv, summary.json, bus.blf, overlay.mp4, overview.png, replay.html.

    The offsets go onto the named CAN bus. Where truth.csv exists, the errors are shown at the end.
    A frame that cannot be read gets a row with its flag, and the rest is tracked. A recording that fails does
    not stop the others. The exit code is then 2. A bus other than virtual needs --onto-a-robot; the robot
    there is listened to.
    The last lines say how many offsets went out, of those wanted, how many frames are valid and, where few
    are, what most likely is wrong. The exit code is 3 where no frame is valid or no wanted offset went out.
    """
    if cell is not None:
        look_at_cell(cell)
    look_at_recordings(recordings, setup)
    from arctrack.control.cell_file import read_cell_file
    from arctrack.recording.parquet_file import check_parquet
    from arctrack.recording.results import REPLAY_MCAP, REPLAY_RRD
    from arctrack.replay.replay import ReplayOptions
    from arctrack.replays import check_bus, jobs_for
    from arctrack.workers import check_choice, cores_each

    check_choice(workers, scheduler)
    if parquet is not None:
        check_parquet(parquet)
    exports = tuple(name for name, wanted in ((REPLAY_MCAP, mcap), (REPLAY_RRD, rrd)) if wanted)
    options = ReplayOptions(
        bus=bus,
        use_arc_map=arc_map,
        pictures=pictures,
        exports=exports,
        cell=None if cell is None else read_cell_file(cell),
        job_number=job,
        onto_a_robot=onto_a_robot,
    )
    at_once = min(workers, len(recordings))
    jobs = jobs_for(recordings, out, setup, options, resume, cores_each(at_once, scheduler))
    if scheduler is not None or at_once > 1:
        check_bus(options)
        jobs = jobs if scheduler is None else [job.absolute() for job in jobs]
        coming = _at_once(jobs, at_once, scheduler)
    else:
        coming = _in_turn(jobs)
    _report(_all_of(coming, jobs, fleet), parquet)


def _all_of(coming: Iterable[Outcome], jobs: list[ReplayJob], fleet: Path | None) -> list[Outcome]:
    """Return what becomes of all recordings in their order, followed by a fleet's page as it comes."""
    from arctrack.fleet import followed
    from arctrack.replays import FLEET_COLUMNS, fleet_row

    outcomes = []
    with followed(fleet, "replay", len(jobs), FLEET_COLUMNS) as on_row:
        for outcome in coming:
            on_row(fleet_row(outcome))
            outcomes.append(outcome)
    places = {job.folder: n for n, job in enumerate(jobs)}
    return sorted(outcomes, key=lambda outcome: places[outcome.job.folder])


def _at_once(jobs: list[ReplayJob], workers: int, scheduler: str | None) -> Iterator[Outcome]:
    """Yield what becomes of each recording as it comes, and say what it warns of."""
    from arctrack.cli import console
    from arctrack.replays import ReplayResult, replay_job
    from arctrack.workers import at_once, executor_of

    kept = "rows so far are in the recordings' results.csv"
    with (
        console.progress() as bar,
        interruptible("replay", kept),
        executor_of(workers, scheduler) as executor,
    ):
        on_recording = console.track(bar, "recordings", len(jobs), "recordings")
        for n, outcome in enumerate(at_once(replay_job, jobs, executor)):
            on_recording(n + 1)
            if isinstance(outcome, ReplayResult):
                console.warn([*outcome.warnings, *outcome.replay_warnings])
                console.say_compiled(outcome.job.name, outcome.warm_up)
            yield outcome


def _in_turn(jobs: list[ReplayJob]) -> Iterator[Outcome]:
    """Replay recordings one after another in this process; one that fails does not stop the others."""
    from arctrack.cli import console
    from arctrack.recording.results import BUS_LOG, RESULTS_CSV
    from arctrack.replays import replay_job
    from arctrack.workers import FailedJob

    with console.progress() as bar:
        for job in jobs:
            bar.get_ready(job.name)
            kept = f"rows so far are in {job.folder / RESULTS_CSV}, what was sent in {job.folder / BUS_LOG}"
            try:
                with interruptible(f"{job.name}: replay", kept):
                    done = replay_job(job, partial(_begin, bar, job))
            except (ArctrackError, OSError) as error:
                yield FailedJob(job, error)
                continue
            console.say_compiled(job.name, done.warm_up)
            console.warn([*(done.warnings if done.is_taken_over else ()), *done.replay_warnings])
            yield done


def _begin(bar: Progress, job: ReplayJob, recording: Recording) -> Listeners:
    """Print the doubts about a recording, and start the display of its replay's progress."""
    from arctrack.cli import console
    from arctrack.replays import Listeners

    console.warn(recording.warnings)
    name, rows, options = job.name, len(recording.rows), job.options
    on_frame = console.track(bar, name, rows)
    draws = options.pictures or bool(options.exports)
    compares = not options.use_arc_map and recording.has_truth
    return Listeners(
        on_frame,
        console.track(bar, f"{name}, pictures", rows) if draws else None,
        console.track(bar, f"{name}, arc map", rows) if compares else None,
    )


def _report(outcomes: list[Outcome], parquet: Path | None) -> None:
    """Print the results of the recordings, and exit with their code, if that is not 0.

    The frames of those that did not fail go into the Parquet file, where one is wanted.
    """
    from arctrack.cli import console
    from arctrack.replays import ReplayResult
    from arctrack.workers import FailedJob

    done = [outcome for outcome in outcomes if isinstance(outcome, ReplayResult)]
    failed = [outcome for outcome in outcomes if isinstance(outcome, FailedJob)]
    _show(done, len(outcomes) > 1)
    for replayed in done:
        console.say(
            f"{replayed.job.name}: {replayed.verdict.line}",
            f"{replayed.job.name}: {'taken over: ' if replayed.is_taken_over else ''}results in "
            f"{replayed.job.folder}",
        )
    complaints = [*(failure.problem for failure in failed), *(r.complaint for r in done if r.complaint)]
    console.complain(complaints)
    if parquet is not None:
        from arctrack.recording.parquet_file import ReplayedRecording, write_parquet

        tracked = [ReplayedRecording(each.job.recording, each.job.folder) for each in done]
        rows = write_parquet(parquet, tracked)
        console.say(f"{rows} frames of {len(done)} recordings in {parquet}")
    for failure in failed:
        if not failure.foreseen:
            raise failure.error
    _end(complaints, [replayed.verdict for replayed in done])


def _end(complaints: list[str], verdicts: list[RunVerdict]) -> None:
    from arctrack.cli.exit_codes import BAD_INPUT, NOTHING_TRACKED

    if complaints:
        raise typer.Exit(BAD_INPUT)
    if any(verdict.nothing_tracked for verdict in verdicts):
        raise typer.Exit(NOTHING_TRACKED)


def _show(done: list[ReplayResult], of_several: bool) -> None:
    from arctrack.cli import console
    from arctrack.cli.replay_table import in_words, many_table, one_table

    screen = console.tables()
    summaries = [summary for replayed in done for summary in replayed.summaries]
    if of_several and summaries:
        taken_over = [replayed.is_taken_over for replayed in done for _ in replayed.summaries]
        screen.print(many_table(summaries, taken_over))
    elif summaries:
        if summaries[0].score is not None:
            screen.print(one_table(summaries))
        for summary in summaries:
            screen.print(in_words(summary), markup=False, soft_wrap=True)
