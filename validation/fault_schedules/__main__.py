"""`python -m validation.fault_schedules`: faults in a simulated cell, and what became of them as a table."""

from __future__ import annotations

from typing import Annotated

import typer

from arctrack.cli import console, run_app
from arctrack.cli.exit_codes import WARNED
from arctrack.cli.group import reflow
from validation.fault_schedules.schedules import executor, run_schedule, run_schedules
from validation.fault_schedules.table import failures, table

app = typer.Typer(rich_markup_mode="rich", pretty_exceptions_enable=False)


@app.command(epilog="Example: python -m validation.fault_schedules --count 50 --seed 1 --workers 2")
def schedules(
    count: Annotated[int, typer.Option(min=1, help="How many schedules; each has the next fault.")] = 50,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all that is drawn at random.")] = 1,
    only: Annotated[int | None, typer.Option(min=0, help="Run this one schedule of the seed alone.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Schedules run at once, a process each.")] = 1,
) -> None:
    """Let faults happen in a cell, and print what became of them as a table.

    A schedule that failed is named by the options that run it again. The exit code is then 1.
    """
    if only is not None:
        outcomes = [run_schedule(seed, only)]
    else:
        with console.progress() as bar, executor(workers) as pool:
            task = bar.add_task("schedules", total=count, unit="schedules")
            outcomes = []
            for outcome in run_schedules(seed, count, pool):
                outcomes.append(outcome)
                bar.advance(task)
    typer.echo(table(outcomes))
    failed = list(failures(seed, outcomes))
    for line in failed:
        typer.echo(line, err=True)
    if failed:
        raise typer.Exit(WARNED)


reflow(app)

if __name__ == "__main__":
    run_app(app, "python -m validation.fault_schedules")
