"""`arctrack new`: a recording to fill in."""

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.simulate import JointName, MaterialName
from arctrack.output import check_new_folder


def new(
    folder: Annotated[Path, typer.Argument(help="Folder for the recording; must not exist yet.")],
    joint: Annotated[JointName, typer.Option(help="The joint.")] = JointName.V_GROOVE,
    material: Annotated[MaterialName, typer.Option(help="The base metal.")] = MaterialName.MILD_STEEL,
) -> None:
    """Start a recording of your own sensor: a setup that explains each of its numbers, and empty tables.

    The values are those of a sensor that works. Replace them by your own, add frames and poses, and replay.
    """
    check_new_folder(folder)
    from arctrack.recording.new import write_new

    written = write_new(folder, joint.value, material.value)
    typer.echo("\n".join(str(path) for path in written))
    typer.echo(
        f"Next: state your sensor in {written[0].name}, add frames and poses, then arctrack replay {folder}"
    )
