"""`python -m validation.bench`: a benchmark of methods that read a laser's stripe or find a seam."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli import console, run_app
from arctrack.cli.group import CommandGroup, reflow
from arctrack.cli.options import Workers
from arctrack.errors import ArctrackError
from validation.bench import scenes as sets
from validation.bench.engine import all_of, judged, write
from validation.bench.methods import FromStripe, method_named
from validation.bench.rivals import METHODS, NEEDS_TORCH, READERS, SCALES, scaled
from validation.bench.score import SEAM, STRIPE, FrameScore, Statistic, figures, scored

bench = typer.Typer(
    cls=CommandGroup, no_args_is_help=True, rich_markup_mode="rich", pretty_exceptions_enable=False
)


@bench.callback(epilog="Example: python -m validation.bench run")
def _bench() -> None:
    """Hold methods that read a stripe or find a seam against scenes whose truth is known."""


@bench.command(epilog="Example: python -m validation.bench make --out /tmp/scenes --workers 2")
def make(
    out: Annotated[Path, typer.Option(help="Folder for the scenes; made if missing.")],
    kept: Annotated[bool, typer.Option("--kept", help="Only the 16 of the repository.")] = False,
    workers: Workers = 1,
) -> None:
    """Draw the 360 scenes that judge from their seeds, a recording each; what is there is kept."""
    out.mkdir(parents=True, exist_ok=True)
    wanted = [
        (kind, seed)
        for kind in sets.JUDGED
        for seed in sets.seeds_of(kind, sets.KEPT[kind] if kept else None)
        if not (out / f"{kind}_{seed}").is_dir()
    ]
    all_of(partial(write, out), wanted, workers, "scenes")
    console.say(f"{out}: {len(wanted)} scenes drawn")


@bench.command(epilog="Example: python -m validation.bench run /tmp/scenes --workers 2 --method mine:read")
def run(
    scenes: Annotated[Path, typer.Argument(help="Folder of scenes.")] = sets.HERE,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="MODULE:NAME of your own method: a function of an image and the stripe's sigma that gives a "
            "row for each column, or a class; repeat."
        ),
    ] = None,
    only: Annotated[list[str] | None, typer.Option(help="A method by its name in the table; repeat.")] = None,
    workers: Workers = 1,
) -> None:
    """Print the tables of stripe and seam, each figure with the half width of its 95 % interval."""
    paths = sorted(path for path in scenes.iterdir() if path.is_dir()) if scenes.is_dir() else []
    if not paths:
        raise ArctrackError(f"{scenes}: holds no scenes; python -m validation.bench make --out {scenes}")
    for name in only or ():
        if name not in METHODS:
            raise ArctrackError(f"--only {name}: there is no such method; there are {', '.join(METHODS)}")
        if name in NEEDS_TORCH and not _has_network():
            raise ArctrackError(
                f"--only {name}: needs pip install torch, and its weights: python -m validation.bench train"
            )
    runnable = [name for name in METHODS if name not in NEEDS_TORCH or _has_network()]
    names = [*(only or runnable), *(method or ())]
    for name in method or ():
        method_named(name)
    results = all_of(partial(judged, names), paths, workers, "scenes")
    for title, statistics, is_of in (
        ("stripe", STRIPE, lambda score: score.reads_stripe),
        ("seam", SEAM, lambda score: score.reads_seam),
    ):
        typer.echo("\n".join(_table(title, names, results, statistics, is_of)))


@bench.command(epilog="Example: python -m validation.bench tune")
def tune() -> None:
    """Print each reader's IoU over 20 other scenes by the width that it is told: the rivals' settings."""
    drawn = [sets.drawn("tune", seed) for seed in sets.seeds_of("tune")]
    typer.echo("| reader | " + " | ".join(f"{scale:g}" for scale in SCALES) + " |")
    for name in READERS:
        cells = []
        for scale in SCALES:
            scores = [scored(FromStripe(scaled(name, scale)), scene) for scene in drawn]
            cells.append(f"{STRIPE['IoU']([score for scene in scores for score in scene]):.3f}")
        typer.echo(f"| {name} | {' | '.join(cells)} |")


@bench.command(epilog="Example: python -m validation.bench train --workers 2")
def train(workers: Workers = 1) -> None:
    """Train the U-Net on 200 other scenes and write its weights; needs PyTorch."""
    from validation.bench import unet

    drawn = all_of(partial(sets.drawn, "learn"), sets.seeds_of("learn"), workers, "scenes")
    with console.progress() as bar:
        unet.train(drawn, console.track(bar, "u-net", unet.STEPS, "steps"))
    console.say(f"{unet.WEIGHTS}: written")


def _has_network() -> bool:
    from importlib.util import find_spec

    from validation.bench.unet import WEIGHTS

    return find_spec("torch") is not None and WEIGHTS.exists()


def _table(
    title: str,
    names: Sequence[str],
    results: Sequence[dict[str, list[FrameScore]]],
    statistics: dict[str, Statistic],
    is_of: Callable[[FrameScore], bool],
) -> Iterator[str]:
    """Yield a table's lines: a row a method."""
    yield f"\n| {title} | {' | '.join(statistics)} |"
    yield f"| --- |{' --- |' * len(statistics)}"
    for name in names:
        scenes = [[score for score in result[name] if is_of(score)] for result in results]
        if not any(scenes):
            continue
        values = [figure for _, figure in figures(scenes, statistics)]
        cells = [_cell(each.value, 0.5 * (each.high - each.low)) for each in values]
        yield f"| {name} | {' | '.join(cells)} |"


def _cell(value: float, half: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3g} ± {half:.1g}"


reflow(bench)

if __name__ == "__main__":
    run_app(bench, "python -m validation.bench")
