"""`arctrack replay`: recordings in, offsets on the bus and results out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.interrupt import interruptible
from arctrack.errors import ArctrackError, as_line

if TYPE_CHECKING:
    from rich.progress import Progress

    from arctrack.check.verdict import Verdict
    from arctrack.recording import Recording
    from arctrack.recording.results import Summary
    from arctrack.replay import Replay, ReplayOptions


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
    arc_map: Annotated[
        bool,
        typer.Option(
            "--arc-map/--no-arc-map",
            help="Without the arc map: local median background, constant variance. Where the truth is known, "
            "the numbers with the map are shown beside it.",
        ),
    ] = True,
    pictures: Annotated[
        bool, typer.Option("--pictures/--no-pictures", help="Write overlay.mp4, overview.png, replay.html.")
    ] = True,
    mcap: Annotated[
        bool, typer.Option("--mcap", help="Write replay.mcap too, for Foxglove. Needs arctrack\\[mcap].")
    ] = False,
    rrd: Annotated[
        bool, typer.Option("--rrd", help="Write replay.rrd too, for Rerun. Needs arctrack\\[rerun].")
    ] = False,
) -> None:
    """Track recordings; write results.csv, summary.json, bus.blf, overlay.mp4, overview.png, replay.html.

    The offsets go onto the named CAN bus. Where truth.csv exists, the errors are shown at the end.
    A frame that cannot be read gets a row with its flag, and the rest is tracked. A recording that fails does
    not stop the others. The exit code is then 2. A bus other than virtual needs --onto-a-robot; the robot
    there is listened to.
    The last lines say how many frames are valid and, where few are, what most likely is wrong. The exit code
    is 3 where no frame is valid.
    """
    from arctrack import replay as engine
    from arctrack.cell_file import read_cell_file
    from arctrack.check.verdict import verdict_on
    from arctrack.cli import console
    from arctrack.recording import read_recording
    from arctrack.recording.results import REPLAY_MCAP, REPLAY_RRD

    folders = results_folders(recordings, out)
    exports = tuple(name for name, wanted in ((REPLAY_MCAP, mcap), (REPLAY_RRD, rrd)) if wanted)
    options = engine.ReplayOptions(
        bus=bus,
        use_arc_map=arc_map,
        pictures=pictures,
        exports=exports,
        cell=None if cell is None else read_cell_file(cell),
        job_number=job,
        onto_a_robot=onto_a_robot,
    )
    complaints: list[str] = []
    summaries: list[Summary] = []
    verdicts: list[Verdict] = []
    written: list[str] = []
    with console.progress() as bar:
        for path, folder in zip(recordings, folders, strict=True):
            # What is wrong with one recording does not stop the others.
            try:
                done = _replayed(bar, read_recording(path, setup), folder, options)
                recording = done.recording
                summaries.append(done.summary)
                verdicts.append(verdict_on(recording, done.tracks))
                written.append(f"{recording.name}: {verdicts[-1].line}")
                written.append(f"{recording.name}: results in {folder}")
                if done.complaint is not None:
                    complaints.append(done.complaint)
                if not arc_map and recording.has_truth:
                    on_frame = console.track(bar, f"{recording.name}, arc map", len(recording.rows))
                    summaries.append(engine.track_alone(recording, True, on_frame))
            except (ArctrackError, OSError) as error:
                complaints.append(as_line(error, path))
    _show(summaries, len(recordings) > 1)
    console.say(*written)
    console.complain(complaints)
    _end(complaints, verdicts)


def _replayed(bar: Progress, recording: Recording, folder: Path, options: ReplayOptions) -> Replay:
    """Replay a recording with all that is said meanwhile."""
    from arctrack import replay as engine
    from arctrack.cli import console
    from arctrack.recording.results import BUS_LOG, RESULTS_CSV

    console.warn(recording.warnings)
    on_frame = console.track(bar, recording.name, len(recording.rows))
    on_drawn = None
    if options.pictures or options.exports:
        on_drawn = console.track(bar, f"{recording.name}, pictures", len(recording.rows))
    on_compiled = console.compiling(bar, recording.name)
    kept = f"rows so far are in {folder / RESULTS_CSV}, what was sent in {folder / BUS_LOG}"
    with interruptible(f"{recording.name}: replay", kept):
        done = engine.replay_recording(recording, folder, options, on_frame, on_drawn, on_compiled)
    console.say_compiled(recording.name, done.warm_up)
    console.warn(f"{recording.path}: {warning}" for warning in done.warnings)
    return done


def _end(complaints: list[str], verdicts: list[Verdict]) -> None:
    """Leave with the exit code of what came out, if it is not 0."""
    from arctrack.cli.exit_codes import BAD_INPUT, NOTHING_TRACKED

    if complaints:
        raise typer.Exit(BAD_INPUT)
    if any(verdict.nothing_tracked for verdict in verdicts):
        raise typer.Exit(NOTHING_TRACKED)


def _show(summaries: list[Summary], of_several: bool) -> None:
    from arctrack.cli import console
    from arctrack.cli.replay_table import in_words, many_table, one_table

    screen = console.tables()
    if of_several and summaries:
        screen.print(many_table(summaries))
    elif summaries:
        if summaries[0].score is not None:
            screen.print(one_table(summaries))
        for summary in summaries:
            screen.print(in_words(summary), markup=False, soft_wrap=True)


def results_folders(recordings: list[Path], out: Path | None) -> list[Path]:
    """Return where each recording's results go; ArctrackError if two would share a folder."""
    from arctrack.output import real
    from arctrack.replay import RESULTS_FOLDER

    if out is None:
        folders = [path / RESULTS_FOLDER for path in recordings]
    elif len(recordings) == 1:
        folders = [out]
    else:
        folders = [out / real(path).name for path in recordings]
    for n, folder in enumerate(folders):
        if real(folder) in [real(other) for other in folders[:n]]:
            raise ArctrackError(f"{recordings[n]}: its results would replace others in {folder}")
    return folders
