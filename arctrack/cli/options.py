"""Options that several commands have in common."""

from pathlib import Path
from typing import Annotated

import typer

from arctrack.errors import ArctrackError

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
Fleet = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        help="Write fleet.html, a page that follows the work, and fleet.parquet, a row a recording, into a "
        "folder. Needs arctrack\\[parquet].",
    ),
]
Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Take over recordings that an earlier run finished, of the same files, options and version.",
    ),
]
Poses = Annotated[Path | None, typer.Option(help="The robot's pose of each image: a table, or matrices.")]
Rotation = Annotated[
    str | None,
    typer.Option(
        help="How rotations are written: kuka, fanuc, abb, ur, staubli, yaskawa; xyzw, wxyz, rotvec; "
        "matrix; or axes: ZYX turns along, xyz is fixed. Default: columns qx, qy, qz, qw."
    ),
]
Translations = Annotated[
    Path | None, typer.Option(help="With --poses of rotation matrices: the file of their translations.")
]
NamedColumns = Annotated[
    list[str] | None, typer.Option(help="NAME=COLUMN: what a CSV column is, such as x=tcp_x; repeat.")
]


def named_columns(texts: list[str]) -> dict[str, str]:
    """Return the columns that --column names; ArctrackError for what names none, or one twice."""
    named: dict[str, str] = {}
    for text in texts:
        name, equals, header = (part.strip() for part in text.partition("="))
        if not (name and equals and header):
            raise ArctrackError(f"--column {text}: give NAME=COLUMN, such as x=tcp_x")
        if name in named:
            raise ArctrackError(f"--column {text}: {name} is {named[name]} already; leave one of them")
        named[name] = header
    return named
