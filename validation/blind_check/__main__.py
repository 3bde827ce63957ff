"""`python -m validation.blind_check`: recordings with sealed effects, their diagnosis and its score."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli import run_app
from arctrack.cli.group import CommandGroup, reflow
from arctrack.cli.options import Workers
from arctrack.errors import in_file

check = typer.Typer(
    cls=CommandGroup, no_args_is_help=True, rich_markup_mode="rich", pretty_exceptions_enable=False
)

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="The check's folder.")]
Folders = Annotated[list[Path], typer.Argument(metavar="DIR", help="Folders of checks.")]


@check.callback(epilog="Example: python -m validation.blind_check make --out /tmp/check --draws 1 --tiers AE")
def _check() -> None:
    """Check the diagnosis on recordings with sealed effects: make them, run it, open the labels."""


@check.command(epilog="Example: python -m validation.blind_check make --out /tmp/check --draws 3 --workers 2")
def make(
    out: Annotated[Path, typer.Option(help="The check's folder; made if missing.")],
    draws: Annotated[
        int, typer.Option(min=0, help="Recordings of each effect in tiers A, C, D, F, G and H.")
    ] = 3,
    quiet_draws: Annotated[
        int, typer.Option(min=0, help="Recordings of tiers E and I, without any effect.")
    ] = 50,
    tiers: Annotated[
        str,
        typer.Option(
            help="A: one effect; B: A's and G's again, it withheld; C: one of another form; D: two; E: none; "
            "F: one, in a run whose frames are all taken alike. In more joints and views: G: one of a form "
            "that nothing was tuned on; H: three; I: none, values and seam far off."
        ),
    ] = "ABCDEF",
    seed: Annotated[int, typer.Option(min=0, help="Seed of all that is drawn at random.")] = 0,
    width_px: Annotated[int, typer.Option(min=1, help="Width of the images: 640, 320 or 160 px.")] = 640,
    workers: Workers = 1,
) -> None:
    """Make recordings with hidden effects and seal their labels; what is there is not made again."""
    from validation.blind_check import blind_check as engine

    engine.make(out, engine.CheckPlan(draws, quiet_draws, tiers, seed, width_px), workers, _say)
    typer.echo(f"{out / engine.SEALED}: all labels are sealed; python -m validation.blind_check run {out}")


@check.command(epilog="Example: python -m validation.blind_check run /tmp/check --workers 2")
def run(folder: Folder, workers: Workers = 1) -> None:
    """Diagnose the recordings, their labels closed; what is diagnosed is not diagnosed again."""
    from validation.blind_check import blind_check as engine

    engine.run(folder, workers, _say)
    typer.echo(f"{folder / engine.RESULTS}: all is diagnosed; python -m validation.blind_check open {folder}")


@check.command(epilog="Example: python -m validation.blind_check more /tmp/check --workers 2")
def more(folder: Folder, workers: Workers = 1) -> None:
    """Let recordings go on with the experiment asked for next, and diagnose them; what is there stays."""
    from validation.blind_check import blind_check as engine

    engine.more(folder, workers, _say)
    typer.echo(
        f"{folder / engine.RESULTS}: no experiment is left; python -m validation.blind_check open {folder}"
    )


@check.command("open", epilog="Example: python -m validation.blind_check open /tmp/check")
def open_labels(folders: Folders) -> None:
    """Open the labels and print the scores with their 95 % bounds.

    Of one check they are written to table.md and scores.json too; several are scored together.
    """
    from validation.blind_check import blind_check as engine
    from validation.blind_check.score_table import table

    opened = engine.open_labels(*folders)
    text = table(opened)
    typer.echo(text)
    if len(folders) > 1:
        return
    (folder,) = folders
    try:
        (folder / "table.md").write_text(text, encoding="utf-8")
        content = json.dumps(engine.scores_json(opened), indent=1, allow_nan=False)
        (folder / "scores.json").write_text(content + "\n", encoding="utf-8")
    except OSError as error:
        raise in_file(folder, f"cannot be written: {error.strerror}") from None


def _say(what: str, done: int, total: int) -> None:
    typer.echo(f"{done} of {total}: {what}", err=True)


reflow(check)

if __name__ == "__main__":
    run_app(check, "python -m validation.blind_check")
