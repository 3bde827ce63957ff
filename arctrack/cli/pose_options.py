"""Options of all commands for the robot's poses and their notation."""

from pathlib import Path
from typing import Annotated

import typer

from arctrack.errors import ArctrackError

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
