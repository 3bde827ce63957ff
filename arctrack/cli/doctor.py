"""`arctrack doctor`: can this machine run a cell live, and how late would its offsets go out?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from arctrack.cli.exit_codes import UNFIT
from arctrack.cli.inputs import look_at_cell
from arctrack.cli.interrupt import interruptible
from arctrack.cli.json_output import AsJson, say_json
from arctrack.system import require_live

if TYPE_CHECKING:
    from rich.table import Table

    from arctrack.live.doctor.examine import Budget
    from arctrack.live.doctor.finding import DoctorFinding, FindingState


def doctor(
    cell: Annotated[
        Path | None, typer.Argument(help="A cell file, cell.toml; without it the machine alone.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check a machine, and a cell on it: clock, scheduler, memory, bus, camera, what is compiled.

    With a cell it also measures the tracker on frames drawn of the cell's own setup, and works out how late
    an offset goes out. Nothing is sent, and the laser stays off: not beside a live run of the same cell.
    The exit code is 1 if something failed, without which a live run cannot do, and 0 otherwise.
    """
    require_live("doctor")
    if cell is not None:
        look_at_cell(cell)
    from arctrack.cli import console
    from arctrack.control.cell_file import read_cell_file
    from arctrack.live.doctor.examine import Examination, examine_cell, examine_machine
    from arctrack.live.doctor.finding import FindingState

    examination, counts = Examination(), dict.fromkeys(FindingState, 0)
    examined: list[DoctorFinding] = []
    read = None if cell is None else read_cell_file(cell)
    with interruptible("doctor was", "nothing was written"), console.progress() as bar:
        if read is None:
            findings = examine_machine(Path.cwd())
        else:
            console.warn(read.setup.warnings)
            findings = examine_cell(
                read, lambda what, total: console.track(bar, what, total, "steps"), examination
            )
        for finding in findings:
            counts[finding.state] += 1
            examined.append(finding)
            if not as_json:
                console.say(_line(finding))
    if as_json:
        say_json("doctor", json_content(cell, examined, counts, examination.budget))
    else:
        if examination.budget is not None:
            console.tables().print(_table(examination.budget))
        console.say(", ".join(f"{state.value} {count}" for state, count in counts.items()))
    if counts[FindingState.FAILED]:
        raise typer.Exit(UNFIT)


def json_content(
    cell: Path | None, findings: list[DoctorFinding], counts: dict[FindingState, int], budget: Budget | None
) -> dict[str, Any]:
    """Return an examination for programs."""
    return {
        "cell": cell,
        "findings": [{**vars(finding), "state": finding.state.value} for finding in findings],
        "counts": {state.value: count for state, count in counts.items()},
        "budget": None
        if budget is None
        else {
            "parts": [vars(part) for part in budget.parts],
            "typical_s": budget.typical_s,
            "at_most_s": budget.at_most_s,
            "capture_age_s": budget.capture_age_s,
        },
    }


def _line(finding: DoctorFinding) -> str:
    return f"{finding.state.value:8} {finding}"


def _table(budget: Budget) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(
        title="from mid-exposure to the offset, ms",
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        padding=(0, 1),
    )
    for heading, side in (("part", "left"), ("typical", "right"), ("at most", "right"), ("from", "left")):
        table.add_column(heading, justify="right" if side == "right" else "left")
    for part in budget.parts:
        table.add_row(part.name, _ms(part.typical_s), _ms(part.at_most_s), part.source)
    table.add_section()
    limit = f"the oldest capture of the gate: {_ms(budget.capture_age_s)}"
    table.add_row("sum", _ms(budget.typical_s), _ms(budget.at_most_s), limit)
    return table


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.1f}"
