"""Options of all commands that track frames."""

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
