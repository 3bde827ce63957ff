"""`arctrack replay`: recordings in, offsets on the bus and results out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.errors import ArctrackError

if TYPE_CHECKING:
    from arctrack.recording import Recording
    from arctrack.recording.results import Summary


def replay(
    recordings: Annotated[list[Path], typer.Argument(help="Folders that hold a recording each.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Where results go; default: results/ in the recording. A folder each for several."),
    ] = None,
    setup: Annotated[
        Path | None, typer.Option(help="A recording.toml to use instead of each recording's own.")
    ] = None,
    bus: Annotated[
        str, typer.Option(help="CAN bus for the offsets, python-can's interface:channel.")
    ] = "virtual:arctrack",
    arc_map: Annotated[
        bool,
        typer.Option(
            "--arc-map/--no-arc-map",
            help="Without the arc map: local median background, constant variance. Where the truth is known, "
            "the numbers with the map are shown beside it.",
        ),
    ] = True,
    pictures: Annotated[
        bool, typer.Option("--pictures/--no-pictures", help="Write overlay.mp4 and overview.png.")
    ] = True,
) -> None:
    """Track recordings; write results.csv, summary.json, bus.blf, overlay.mp4 and overview.png.

    The offsets go onto the named CAN bus. Where truth.csv exists, the errors are shown at the end.
    A frame that cannot be read gets a row with its flag, the rest is tracked, and the exit code is 2.
    """
    from arctrack import replay as engine
    from arctrack.cli import console
    from arctrack.cli.replay_table import in_words, many_table, one_table
    from arctrack.recording import read_recording

    read = [read_recording(path, setup) for path in recordings]
    folders = results_folders(read, out)
    options = engine.ReplayOptions(bus=bus, use_arc_map=arc_map, pictures=pictures)
    complaints: list[str] = []
    summaries: list[Summary] = []
    with console.progress() as bar:
        for recording, folder in zip(read, folders, strict=True):
            console.warn(recording.warnings)
            on_frame = console.track(bar, recording.name, len(recording.rows))
            done = engine.replay_recording(recording, folder, options, on_frame)
            summaries.append(done.summary)
            if not arc_map and recording.has_truth:
                on_frame = console.track(bar, f"{recording.name}, arc map", len(recording.rows))
                summaries.append(engine.track_alone(recording, True, on_frame))
            if done.complaint is not None:
                complaints.append(done.complaint)
    screen = console.tables()
    if len(read) > 1:
        screen.print(many_table(summaries))
    else:
        if summaries[0].score is not None:
            screen.print(one_table(summaries))
        for summary in summaries:
            screen.print(in_words(summary), markup=False, soft_wrap=True)
    for recording, folder in zip(read, folders, strict=True):
        screen.print(f"{recording.name}: results in {folder}", markup=False, soft_wrap=True)
    if complaints:
        raise ArctrackError("; ".join(complaints))


def results_folders(recordings: list[Recording], out: Path | None) -> list[Path]:
    """Return where each recording's results go; ArctrackError if two would share a folder."""
    from arctrack.replay import RESULTS_FOLDER

    if out is None:
        folders = [recording.path / RESULTS_FOLDER for recording in recordings]
    elif len(recordings) == 1:
        folders = [out]
    else:
        folders = [out / recording.name for recording in recordings]
    for n, folder in enumerate(folders):
        if folder.resolve() in [other.resolve() for other in folders[:n]]:
            raise ArctrackError(f"{recordings[n].path}: its results would replace others in {folder}")
    return folders
