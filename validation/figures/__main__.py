"""`python -m validation.figures`: pictures of what the model says, made anew."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli import run_app
from arctrack.cli.group import CommandGroup, reflow
from arctrack.errors import in_file

figures = typer.Typer(
    cls=CommandGroup, no_args_is_help=True, rich_markup_mode="rich", pretty_exceptions_enable=False
)


@figures.callback(epilog="Example: python -m validation.figures paper --out /tmp/figures")
def _figures() -> None:
    """Draw figures from the model."""


@figures.command(epilog="Example: python -m validation.figures paper --out /tmp/figures")
def paper(
    out: Annotated[Path, typer.Option(help="Folder for the pictures and their numbers; made if missing.")],
) -> None:
    """Draw the paper's Figures 6 to 12: figure_06.png and so on, and each one's curves as CSV beside it."""
    from arctrack.cli import console
    from validation.figures import paper_figures
    from validation.figures.paper_curves import FIGURES

    try:
        out.mkdir(parents=True, exist_ok=True)
        with console.progress() as bar:
            task = bar.add_task("figures", total=len(FIGURES), unit="figures")
            for number in FIGURES:
                curves = FIGURES[number]()
                path = out / f"figure_{number:02d}.png"
                paper_figures.write_png(paper_figures.draw(curves), path)
                paper_figures.write_csv(curves, path.with_suffix(".csv"))
                typer.echo(f"{path} and .csv")
                bar.advance(task)
    except OSError as error:
        raise in_file(out, f"cannot be written: {error}") from None


@figures.command(epilog="Example: python -m validation.figures effects --out /tmp/effects")
def effects(
    out: Annotated[Path, typer.Option(help="Folder for effects.md and figures/effects/; made if missing.")],
) -> None:
    """Write the page on effects, effects.md, and draw each of them as figures/effects/ID.png beside it."""
    from arctrack.cli import console
    from noise_model.effects import REGISTRY
    from validation.figures import effects_page

    try:
        with console.progress() as bar:
            task = bar.add_task("effects", total=len(REGISTRY), unit="effects")
            effects_page.write(out, REGISTRY, lambda path: bar.advance(task))
    except OSError as error:
        raise in_file(out, f"cannot be written: {error}") from None
    typer.echo(f"{out / effects_page.PAGE} and its pictures, {out / effects_page.PICTURES}/*.png")


@figures.command(epilog="Example: python -m validation.figures joints --out docs/reference/pictures")
def joints(
    out: Annotated[Path, typer.Option(help="Folder for joints.svg; made if missing.")],
) -> None:
    """Draw the cross-sections of all joints with their seam points: joints.svg."""
    from validation.figures.joint_sections import draw_joints

    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "joints.svg").write_text(draw_joints())
    except OSError as error:
        raise in_file(out, f"cannot be written: {error}") from None
    typer.echo(f"{out / 'joints.svg'}")


@figures.command(epilog="Example: python -m validation.figures animation --out docs/tutorial/pictures")
def animation(
    out: Annotated[Path, typer.Option(help="Folder for replay.webp; made if missing.")],
) -> None:
    """Replay a simulated weld whose arc burns, half a minute of it: replay.webp."""
    from validation.figures.animation import write_animation

    try:
        out.mkdir(parents=True, exist_ok=True)
        write_animation(out / "replay.webp")
    except OSError as error:
        raise in_file(out, f"cannot be written: {error}") from None
    typer.echo(f"{out / 'replay.webp'}")


reflow(figures)

if __name__ == "__main__":
    run_app(figures, "python -m validation.figures")
