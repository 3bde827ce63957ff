"""`arctrack calibrate sensor`: gain, noise and response of a sensor from flat and dark frames."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.setups import check_can_be_replaced, read_setup, write_calibrated
from arctrack.errors import ArctrackError, in_file
from arctrack.output import write_whole

if TYPE_CHECKING:
    from arctrack.recording import SetupFile
    from arctrack.report.calibration.page import CalibrationPage

REPORT = "calibrate_sensor.html"

EXAMPLE = "Example: arctrack calibrate sensor /tmp/flats --setup examples/v_groove --out /tmp/sensor.toml"


def sensor(
    source: Annotated[Path, typer.Argument(help="Folder of flat and dark frames.")],
    setup: Annotated[Path, typer.Option(help="A recording.toml, or a recording, that it belongs to.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Where to write recording.toml; default: the setup, the one before is kept."),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help=f"Where the page goes; default: {REPORT} beside the written file.")
    ] = None,
    gamma: Annotated[float | None, typer.Option(help="Hold this gamma in place of fitting it.")] = None,
) -> None:
    """Find gain, read noise, black level, full well, gamma, DSNU and PRNU of a sensor, each with its sigma.

    The folder holds two or more frames of an even, steady light at five or more exposures, and two or more in
    the dark. Names say which is which: flat_2.5ms_1.png, dark_500us/0002.tif; or a table exposures.csv does,
    with file,exposure_ms,lit. What the frames cannot determine is refused, with the frames that are missing.
    """
    if gamma is not None and not 0.1 < gamma < 10.0:
        raise ArctrackError(f"--gamma {gamma:g}: a sensor's lies between 0.1 and 10")
    stated = read_setup(setup)
    target = out or stated.path
    page_path = report or target.with_name(REPORT)
    for path in (target, page_path):
        check_can_be_replaced(path)
    _flat_fields(source, stated, target, page_path, gamma)


def _flat_fields(source: Path, stated: SetupFile, target: Path, page_path: Path, gamma: float | None) -> None:
    from arctrack.calibration_files.flat_frames import find_flat_frames, read_levels
    from arctrack.calibration_files.sensor_record import flat_record
    from arctrack.cli import console
    from arctrack.importing.grey import channel_of_laser
    from arctrack.report.calibration.sensor import sensor_page
    from calibration.sensor.flat_fields import calibrate_sensor

    files, vague = find_flat_frames(source)
    bits = stated.setup.sensor.bits
    with console.progress() as bar:
        task = bar.add_task("exposures", total=None, unit="exposures")
        try:
            levels, lossy = read_levels(
                files,
                channel_of_laser(stated.setup),
                bits,
                lambda done, total: bar.update(task, completed=done, total=total),
            )
            result = calibrate_sensor(levels, bits, gamma)
        except ValueError as error:
            raise in_file(source, str(error)) from None
    warnings = [*vague, *lossy]
    console.warn(warnings)
    _finish(sensor_page(result, levels, source.name, warnings), page_path)
    write_calibrated(target, stated.path, flat_record(result))


def _finish(page: CalibrationPage, path: Path) -> None:
    """Print a page's values and write it."""
    from rich.table import Table

    from arctrack.cli import console
    from arctrack.report.calibration.page import render

    table = Table(box=None, pad_edge=False)
    for name, justify in (
        ("", "left"),
        ("value", "right"),
        ("1 σ", "right"),
        ("95 %", "right"),
        ("", "left"),
    ):
        table.add_column(name, justify=justify)  # type: ignore[arg-type]
    for row in page.rows:
        table.add_row(row.what, row.value, row.sigma, row.interval, row.unit)
    screen = console.tables()
    screen.print(table)
    for sentence in (*page.sentences, *page.notes):
        screen.print(sentence, markup=False, soft_wrap=True)
    write_whole(path, render(page))
    console.say(f"report in {path}")
