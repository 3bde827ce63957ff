"""`arctrack import`: raw files of a camera and a robot made into a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.inputs import look_at_file, look_at_images, look_at_setup, setup_path
from arctrack.cli.interrupt import interruptible
from arctrack.cli.options import NamedColumns, Rotation, Translations, named_columns
from arctrack.errors import ArctrackError
from arctrack.recording.importing.colours import Bayer, Channel

if TYPE_CHECKING:
    from rich.progress import TaskID


def import_files(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...",
            help="A folder of images, images, a pattern in quotes, grey FFV1 video, or a profiler's files.",
        ),
    ],
    setup: Annotated[Path, typer.Option(help="The sensor's recording.toml, or a recording that has it.")],
    poses: Annotated[
        Path,
        typer.Option(help="The robot's poses: a table, its controller's points, matrices, or a CAN log."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the recording; must not exist yet.")],
    rotation: Rotation = None,
    units: Annotated[
        str, typer.Option(help="Units that no name states, such as 'm, rad, ms'; names such as x_mm do.")
    ] = "",
    translations: Translations = None,
    column: NamedColumns = None,
    frames: Annotated[
        Path | None,
        typer.Option(help="CSV of the images: time, laser_on, arc_on, current_a, exposure; file or frame."),
    ] = None,
    rate_hz: Annotated[float | None, typer.Option(help="Images a second, by their numbers.")] = None,
    times_in_names: Annotated[
        bool, typer.Option("--times-in-names", help="The images' names hold their times.")
    ] = False,
    current_a: Annotated[
        float | None, typer.Option(help="The arc burns, at this current, A. Default: no arc burns.", min=0.0)
    ] = None,
    exposure_s: Annotated[
        float | None, typer.Option(help="Exposure of the images, s. Default: that of the setup.")
    ] = None,
    channel: Annotated[
        Channel | None, typer.Option(help="The colour that becomes grey. Default: the laser's.")
    ] = None,
    profile: Annotated[
        list[str] | None,
        typer.Option(
            help="KEY=VALUE of a profiler's files, CSV, PCD or MCAP: layout, topic, up_mm, across_mm, axes, "
            "sigma, nothing, separator, decimal, zero, middle; repeat. What a file needs is asked for."
        ),
    ] = None,
    bayer: Annotated[
        Bayer | None, typer.Option(help="Images are mosaics: sites of one colour, at half the size.")
    ] = None,
) -> None:
    """Make a recording of raw files: JPEG, PNG, BMP or TIFF images, and poses as the controller writes them.

    Images are taken in the order of their numbers. Units and the notation of rotations are stated, never
    guessed. Nothing is overwritten, and a failure leaves no files.
    """
    look_at_setup(setup)
    look_at_file(poses)
    if profile is None:
        look_at_images(sources)
    else:
        for source in sources:
            look_at_file(source)
    from arctrack.cli import console
    from arctrack.printable import quoted
    from arctrack.recording.importing.import_recording import ImportSources, import_recording
    from arctrack.recording.importing.profile_layout import ProfileLayout
    from arctrack.recording.importing.units import parse_units

    _check_range("--rate-hz", rate_hz, 1e-4, 1e5)
    _check_range("--exposure-s", exposure_s, 1e-9, 3600.0)
    _check_range("--current-a", current_a, 0.0, 1e4)
    raw = ImportSources(
        sources=sources,
        setup=setup_path(setup),
        poses=poses,
        translations=translations,
        frames=frames,
        rotation=rotation,
        units=parse_units(units),
        columns=named_columns(column or []),
        rate_hz=rate_hz,
        times_in_names=times_in_names,
        current_a=current_a,
        exposure_s=exposure_s,
        channel=channel,
        bayer=bayer,
        profile=None if profile is None else ProfileLayout.of(profile),
    )
    with interruptible(f"{out.name}: import", "nothing is kept"), console.progress() as bar:
        tasks: dict[str, TaskID] = {}

        def on_frame(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(f"{out.name}: {what}", total=total, unit="frames")
            bar.update(tasks[what], completed=done)

        imported = import_recording(raw, out, on_frame)
    console.warn([*imported.recording.warnings, *imported.warnings])
    console.say(*(f"{name:11} {note}" for name, note in imported.notes.items() if note))
    recording = imported.recording
    console.say(f"{out}: {len(recording.rows)} frames, {len(recording.poses.timestamps_s)} poses")
    console.say(f"Next: arctrack check {quoted(out)}")


def _check_range(option: str, value: float | None, least: float, most: float) -> None:
    if value is not None and not least <= value <= most:
        raise ArctrackError(f"{option} {value:g}: must be from {least:g} to {most:g}")
