"""`arctrack figures`: pictures of what the model says, made anew."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from arctrack.errors import in_file

figures = typer.Typer(name="figures", help="Draw figures from the model.", no_args_is_help=True)


@figures.callback(epilog="Example: arctrack figures paper --out /tmp/figures")
def _figures() -> None:
    """Draw figures from the model."""


@figures.command(epilog="Example: arctrack figures paper --out /tmp/figures")
def paper(
    out: Annotated[Path, typer.Option(help="Folder for the pictures and their numbers; made if missing.")],
) -> None:
    """Draw the paper's Figures 6 to 12: figure_06.png and so on, and each one's curves as CSV beside it."""
    from rich.console import Console
    from rich.progress import track

    from arctrack.report import paper_figures
    from noise_model.paper_figures import FIGURES

    console = Console(stderr=True)
    try:
        out.mkdir(parents=True, exist_ok=True)
        for number in track(FIGURES, "figures", console=console, disable=not console.is_terminal):
            curves = FIGURES[number]()
            path = out / f"figure_{number:02d}.png"
            paper_figures.write_png(paper_figures.draw(curves), path)
            paper_figures.write_csv(curves, path.with_suffix(".csv"))
            typer.echo(f"{path} and .csv")
    except OSError as error:
        raise in_file(out, f"cannot be written: {error}") from None
