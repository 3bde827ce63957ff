"""`arctrack calibrate gauge` and `sheet`: the laser sheet by a step or a V of known size, or by any plate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.calibration_output import Out, Report, check_outputs, finish, run_calibration
from arctrack.cli.inputs import (
    look_at_file,
    look_at_images,
    look_at_recording,
    look_at_setup,
    read_setup,
    setup_path,
)
from arctrack.cli.interrupt import interruptible
from arctrack.cli.options import Poses
from arctrack.errors import ArctrackError

if TYPE_CHECKING:
    from arctrack.calibrate.robot_poses import PoseSource
    from arctrack.recording import Recording
    from calibration.gauge.shape import Gauge


def gauge(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...", help="A recording, or folders of images, images, or patterns in quotes."
        ),
    ],
    gauge: Annotated[str, typer.Option(help="step:10mm, or v:90deg:5mm: the flanks' angle and the depth.")],
    setup: Annotated[
        Path | None, typer.Option(help="A recording.toml, or a recording; default: the recording's own.")
    ] = None,
    poses: Poses = None,
    rotation: Annotated[
        str | None,
        typer.Option(
            help="How rotations are written, as for calibrate hand-eye: kuka, xyzw, ZYX and others."
        ),
    ] = None,
    units: Annotated[str, typer.Option(help="Units that no name states, such as 'm, rad'.")] = "",
    check: Annotated[bool, typer.Option("--check", help="Only check the setup's sheet.")] = False,
    within: Annotated[float, typer.Option(help="With --check: how far the size may be off, mm.")] = 0.1,
    out: Out = None,
    report: Report = None,
) -> None:
    """Find the laser sheet from its stripe on a gauge at several poses of the robot, or check it from a few.

    The gauge stands still, and the robot looks at it from several sides: raised, tilted, turned about its z.
    Its own place is found as well, and so is the robot's inaccuracy. Poses that do not determine the sheet
    are refused, with the motion that is missing.

    With --check one image is enough: the setup's sheet measures the gauge's size, and where it is off the
    page names what to calibrate anew. No setup is written. The exit code is 1 where it is not OK.
    """
    shape = _gauge_of(gauge)
    if _is_recording(sources):
        look_at_recording(sources[0], setup)
    else:
        look_at_images(sources)
        if setup is not None:
            look_at_setup(setup)
    if poses is not None:
        look_at_file(poses)
    from arctrack.calibrate.gauge.stage import check_stage, gauge_stage
    from arctrack.cli import console
    from arctrack.cli.exit_codes import WARNED
    from arctrack.recording.importing.image_files import images_of

    if not within > 0.0:
        raise ArctrackError(f"--within {within:g}: must be > 0 mm")
    if check and out is not None:
        raise ArctrackError("--out: --check writes no setup; leave one of them")
    recording = _recording_of(sources, setup)
    if setup is None and recording is None:
        raise ArctrackError("--setup: give the recording.toml whose camera took the images")
    stated = read_setup(recording.setup_path if recording is not None else setup)  # type: ignore[arg-type]
    images = [] if recording is not None else images_of(sources)
    source = recording or sources
    given = _poses_of(poses, rotation, units)
    if not check:
        run_calibration(
            "gauge",
            sources[0],
            lambda steps, warn: gauge_stage(source, shape, stated, given, steps, warn),
            setup=stated.path,
            out=out,
            report=report,
            recording=recording,
            images=images,
        )
        return
    page = report or stated.path.with_name("calibrate_gauge.html")
    check_outputs(None, page, stated.path, recording, images)
    with interruptible("the check was", "nothing was written"), console.progress() as bar:
        seen, verdict = check_stage(source, shape, stated, given, within, console.steps(bar), console.warn)
    finish(seen.page, page)
    if not verdict.is_good:
        raise typer.Exit(WARNED)


def _gauge_of(text: str) -> Gauge:
    from calibration.gauge.shape import Gauge

    try:
        return Gauge.parse(text)
    except ValueError as error:
        raise ArctrackError(f"--gauge: {error}") from None


def _is_recording(sources: list[Path]) -> bool:
    """Return True for one recording, False for images."""
    from arctrack.recording.setup_writer import FILE_NAME

    return len(sources) == 1 and (sources[0] / FILE_NAME).exists()


def _recording_of(sources: list[Path], setup: Path | None) -> Recording | None:
    """Return the recording that the sources are, None for images."""
    from arctrack.recording import read_recording

    if not _is_recording(sources):
        return None
    return read_recording(sources[0], None if setup is None else setup_path(setup), must_fit=False)


def _poses_of(poses: Path | None, rotation: str | None, units: str) -> PoseSource | None:
    from arctrack.calibrate.robot_poses import PoseSource
    from arctrack.recording.importing.units import parse_units

    if poses is None:
        if rotation is not None or units:
            raise ArctrackError(
                "--rotation, --units: have no effect without --poses; state them, or leave these"
            )
        return None
    return PoseSource(poses, None, rotation, parse_units(units))


def sheet(
    recordings: Annotated[
        list[Path],
        typer.Argument(metavar="RECORDING...", help="Recordings of one plate that stays where it is."),
    ],
    setup: Annotated[
        Path | None, typer.Option(help="A recording.toml, or a recording; default: the first recording's.")
    ] = None,
    plate_mm: Annotated[
        float | None,
        typer.Option(
            help="How well the setup's joint states the plate's height, 1 sigma, mm; default: not at all."
        ),
    ] = None,
    out: Out = None,
    report: Report = None,
) -> None:
    """Correct the laser sheet from its stripe on any flat plate, scanned at two or three heights or tilts.

    It is for a laser that was knocked or put back: lens and the camera's pose in the tool stay as they are.
    The plate's own height and tilt are found as well, and the robot's error. What the plate does not tell of
    the sheet is named, with the motion that would. A bow stays as stated.
    """
    for folder in recordings:
        look_at_recording(folder, setup)
    from arctrack.calibrate.sheet.stage import sheet_stage
    from arctrack.cli import console
    from arctrack.recording import read_recording

    if plate_mm is not None and not plate_mm > 0.0:
        raise ArctrackError(f"--plate-mm {plate_mm:g}: must be > 0 mm")
    stated = read_setup(recordings[0] if setup is None else setup)
    read = [read_recording(folder, stated.path, must_fit=False) for folder in recordings]
    for recording in read:
        console.warn(recording.warnings)
    target = out or stated.path
    for recording in read[1:]:
        check_outputs(target, report or target.with_name("calibrate_sheet.html"), stated.path, recording)
    run_calibration(
        "sheet",
        read[0].path,
        lambda steps, warn: sheet_stage(read, stated, plate_mm, steps, warn),
        setup=stated.path,
        out=out,
        report=report,
        recording=read[0],
    )
