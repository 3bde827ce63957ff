"""Options of all commands that process many recordings at once."""

from typing import Annotated

import typer

ArcMap = Annotated[
    bool,
    typer.Option(
        "--arc-map/--no-arc-map",
        help="--arc-map predicts the arc's light for each frame's pose; --no-arc-map takes a local median as "
        "background, of one variance. Where the truth is known, replay then shows both errors.",
    ),
]


Workers = Annotated[int, typer.Option(min=1, help="Recordings worked on at once, a process each.")]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="A Dask cluster's scheduler, to work on recordings there; needs the extra cluster.",
    ),
]
