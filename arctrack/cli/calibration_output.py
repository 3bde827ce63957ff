"""What the calibrations that leave a setup and a page have in common: their files, their table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from arctrack.cli.setups import check_can_be_replaced
from arctrack.output import write_whole

if TYPE_CHECKING:
    from arctrack.report.calibration.page import CalibrationPage


def check_outputs(setup: Path, page: Path) -> None:
    """Raise ArctrackError if the setup or the page could not be written."""
    for path in (setup, page):
        check_can_be_replaced(path)


def finish(page: CalibrationPage, path: Path) -> None:
    """Print a page's values and sentences, and write it."""
    from rich.table import Table

    from arctrack.cli import console
    from arctrack.report.calibration.page import render

    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for name in ("value", "1 σ", "95 %"):
        table.add_column(name, justify="right")
    table.add_column("")
    for row in page.rows:
        table.add_row(row.what, row.value, row.sigma, row.interval, row.unit)
    screen = console.tables()
    screen.print(table)
    for sentence in (*page.sentences, *page.notes):
        screen.print(sentence, markup=False, soft_wrap=True)
    write_whole(path, render(page))
    console.say(f"report in {path}")
