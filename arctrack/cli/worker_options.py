"""Options of all commands that process many recordings at once."""

from typing import Annotated

import typer

Workers = Annotated[int, typer.Option(min=1, help="Recordings worked on at once, a process each.")]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="A Dask cluster's scheduler, to work on recordings there; needs the extra cluster.",
    ),
]
