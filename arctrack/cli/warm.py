"""`arctrack warm`: compile before the shift, so that no frame waits for it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.inputs import look_at_stated

if TYPE_CHECKING:
    from noise_model.setup import Setup
    from tracker.seam.correction import Correction


def warm(
    setups: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Recordings, recording.toml or cell.toml files; without any, each joint's nominal setup."
        ),
    ] = None,
) -> None:
    """Compile the tracker for setups, and keep the machine code on disk.

    A first run takes a minute or more; where all has been compiled before, it takes seconds. `replay` does
    the same for its own setup before it reads the first frame. An update of arctrack compiles anew what has
    changed.
    """
    for path in setups or []:
        look_at_stated(path)
    from arctrack.cli import console
    from arctrack.compiling import compiled_by_two
    from arctrack.errors import in_file
    from tracker.tracker import Tracker

    lines: list[str] = []
    with console.progress() as bar:
        for name, setup, correction in _chosen(setups or []):
            bar.get_ready(name)
            try:
                with compiled_by_two(setup):
                    done = Tracker(setup, correction=correction).warm_up()
            except ValueError as error:
                raise in_file(Path(name), str(error)) from error
            lines.append(f"{name}: {done.compiled} functions compiled, ready after {done.elapsed_s:.1f} s")
    console.say(*lines)


def _chosen(paths: list[Path]) -> list[tuple[str, Setup, Correction]]:
    from arctrack.cli.inputs import read_setup
    from arctrack.control.cell_file import is_cell_file, read_cell_file
    from arctrack.nominal import DIMENSIONS, nominal_setup
    from tracker.seam.correction import UNSTATED

    if not paths:
        return [(joint, nominal_setup(joint, "mild_steel"), UNSTATED) for joint in DIMENSIONS]
    chosen: list[tuple[str, Setup, Correction]] = []
    for path in paths:
        if is_cell_file(path):
            cell = read_cell_file(path)
            jobs = cell.jobs.items()
            chosen += [(f"{path} job {n}", j.setup_for(cell.setup.setup), j.correction) for n, j in jobs]
        else:
            setup_file = read_setup(path)
            chosen.append((str(path), setup_file.setup, setup_file.correction))
    return chosen
