"""`arctrack calibrate check`: does a setup explain a recording, and what to calibrate anew if not."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.calibration_output import Report, check_outputs
from arctrack.cli.inputs import look_at_recording, setup_path

if TYPE_CHECKING:
    from arctrack.calibrate.check.check_setup import SetupCheck
    from arctrack.calibrate.check.measure import Measure


def check(
    setup: Annotated[Path, typer.Argument(help="A recording.toml, or a recording whose setup it is.")],
    recording: Annotated[Path, typer.Argument(help="Folder that holds a recording.")],
    report: Report = None,
) -> None:
    """Check stage by stage that a setup explains a recording, and name what to calibrate anew if not.

    The stages are the sensor, camera with laser and hand-eye, the stripe, and the arc. It prints each
    quantity as measured and as expected, with the sigma of their difference, a verdict and a cure. It
    compares a stripe off its place with an error of each part of the setup. Where the poses do not separate
    these, it names all of them, and a recording that would. The exit code is 0 if the setup explains the
    recording, 1 if not, 2 for bad input.
    """
    look_at_recording(recording, setup)
    from arctrack.calibrate.check.check_setup import check_setup
    from arctrack.calibrate.check.page import render
    from arctrack.cli import console
    from arctrack.cli.exit_codes import WARNED
    from arctrack.output import write_whole
    from arctrack.recording import read_recording
    from arctrack.replay.replay import RESULTS_FOLDER

    read = read_recording(recording, setup_path(setup), must_fit=False)
    console.warn(read.warnings)
    page = report or recording / RESULTS_FOLDER / "calibrate_check.html"
    if report is None:
        page.parent.mkdir(parents=True, exist_ok=True)
    check_outputs(None, page, read.setup_path, read)
    with console.progress() as bar:
        checked = check_setup(read, console.track(bar, f"{read.name}: looking at frames", 10))
    _print(checked)
    write_whole(page, render(checked))
    console.say(f"report in {page}")
    console.say(f"{read.name}: {checked.headline}")
    if checked.bad_frames:
        console.warn([f"{checked.bad_frames[0].message}; {len(checked.bad_frames)} of the frames looked at"])
    if checked.not_explained:
        raise typer.Exit(WARNED)


def _print(checked: SetupCheck) -> None:
    from rich.table import Column, Table

    from arctrack.calibrate.check.measure import SetupVerdict
    from arctrack.cli import console

    numbers = (Column(name, justify="right") for name in ("measured", "expected", "1 σ"))
    table = Table("stage", "quantity", *numbers, "", "verdict", box=None, pad_edge=False)
    colours = {SetupVerdict.NOT_EXPLAINED: "red", SetupVerdict.UNTOLD: "yellow", SetupVerdict.OK: "green"}
    stage = None
    for measure in checked.measures:
        first = measure.stage.value if measure.stage is not stage else ""
        stage = measure.stage
        table.add_row(
            first,
            measure.name,
            *measure.shown,
            measure.unit,
            f"[{colours[measure.verdict]}]{measure.verdict.value}[/]",
        )
    screen = console.tables()
    screen.print(table)
    for sentence in (*checked.sentences, *cures(checked.measures)):
        screen.print(sentence, markup=False, soft_wrap=True)


def cures(measures: tuple[Measure, ...]) -> list[str]:
    """Return the cures of quantities that are not explained, a line each."""
    from arctrack.calibrate.check.measure import LightStage, SetupVerdict

    return [
        f"{measure.name}: {measure.cure}"
        for measure in measures
        if measure.verdict is SetupVerdict.NOT_EXPLAINED and measure.stage is not LightStage.PLACE
    ]
