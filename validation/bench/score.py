"""Scores of the benchmark: of a stripe line by line, of a seam frame by frame, of both their sigmas."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from noise_model.compiled.arrays import Bool, Float64
from validation.bench.methods import Method, MethodReading
from validation.bench.scenes import BenchScene, TruthFrame
from validation.bench.stripe_peers import steger

GROSS_SIGMAS, HALF_SIGMAS = 3.0, 2.0
"""A centre is grossly wrong so many sigmas of the stripe off. A mask reaches so far to either side of one."""

FALSE_MM, FALSE_SIGMAS = 0.25, 5.0
"""A valid seam is false so far off, and so many of its own sigmas where it states them."""

DRAWS, SEED = 1000, 0
"""Bootstrap draws of scenes behind an interval, and their seed."""


@dataclass(frozen=True)
class FrameScore:
    """Sums over a frame from which the table's figures come, by scene.

    `lines` show a stripe, `found` of these have a centre that is not `gross`; `false_lines` have one
    without a stripe. `errors_px` are of the found, `pulls` those over their stated sigmas. `inter_px` and
    `union_px` are of the masks about true and read centres, `run` the longest unbroken run of found lines.
    `seam_mm` (2,) is the error of a valid seam, `seam_pulls` (2,) that over its sigmas. `cost` is the CPU
    time over that of Steger's filter.
    """

    lines: int = 0
    found: int = 0
    gross: int = 0
    false_lines: int = 0
    run: int = 0
    errors_px: Float64 | tuple[()] = ()
    pulls: Float64 | tuple[()] = ()
    inter_px: float = 0.0
    union_px: float = 0.0
    has_seam: bool = False
    is_valid: bool = False
    is_false: bool = False
    seam_mm: Float64 | tuple[()] = ()
    seam_pulls: Float64 | tuple[()] = ()
    cost: float = math.nan
    reads_stripe: bool = False
    reads_seam: bool = False


@dataclass(frozen=True)
class BenchFigure:
    """A figure of the table with its 95 % interval; NaN where nothing was scored."""

    value: float
    low: float
    high: float


def scored(method: Method, scene: BenchScene, needs_start: bool = False) -> list[FrameScore]:
    """Run a method over a scene and score each frame; `needs_start` leaves out the first one's seam."""
    method.begin(scene)
    scores = []
    for n, given in enumerate(scene.frames):
        image = scene.upright(given.frame)
        began_s = time.thread_time()
        reading = method.read(image, given.frame, given.pose)
        took_s = time.thread_time() - began_s
        began_s = time.thread_time()
        steger(image, scene.width_px)
        # The first frame loads, and searches.
        cost = took_s / (time.thread_time() - began_s) if n else math.nan
        scores.append(score_frame(reading, given, scene.width_px, cost, is_told=needs_start and n == 0))
    return scores


def score_frame(
    reading: MethodReading, given: TruthFrame, width_px: float, cost: float, is_told: bool = False
) -> FrameScore:
    """Return a frame's score; `is_told`: the method was told of the seam, so that it does not count."""
    stripe = _stripe_sums(reading, given.stripe_px, width_px)
    seam: dict[str, Any] = {} if is_told else _seam_sums(reading, given)
    return FrameScore(**stripe, **seam, cost=cost)


def _stripe_sums(reading: MethodReading, true_px: Float64, width_px: float) -> dict[str, Any]:
    if reading.stripe_px is None:
        return {}
    read, is_true, is_read = reading.stripe_px, np.isfinite(true_px), np.isfinite(reading.stripe_px)
    both = is_true & is_read
    error = np.where(both, read - true_px, np.nan)
    is_found = both & (np.abs(np.nan_to_num(error, nan=np.inf)) <= GROSS_SIGMAS * width_px)
    height = 2.0 * HALF_SIGMAS * width_px
    inter = np.maximum(height - np.abs(error[both]), 0.0)
    sums: dict[str, Any] = {
        "reads_stripe": True,
        "lines": int(is_true.sum()),
        "found": int(is_found.sum()),
        "gross": int((both & ~is_found).sum()),
        "false_lines": int((is_read & ~is_true).sum()),
        "run": _longest_run(is_found[is_true]),
        "errors_px": error[is_found],
        "inter_px": float(inter.sum()),
        "union_px": height * float(is_true.sum() + is_read.sum()) - float(inter.sum()),
    }
    if reading.stripe_sigma_px is not None:
        sums["pulls"] = error[is_found] / reading.stripe_sigma_px[is_found]
    return sums


def _seam_sums(reading: MethodReading, given: TruthFrame) -> dict[str, Any]:
    has_seam, valid = bool(np.isfinite(given.seam_mm).all()), reading.is_valid
    sums: dict[str, Any] = {"reads_seam": True, "has_seam": has_seam, "is_valid": valid}
    if not valid:
        return sums
    if not has_seam:
        return sums | {"is_false": True}
    error = (reading.seam_mm - given.seam_mm)[1:]
    is_off = np.abs(error) > FALSE_MM
    sums["seam_mm"] = error
    if reading.seam_sigma_mm is not None:
        pulls = error / reading.seam_sigma_mm
        sums["seam_pulls"], is_off = pulls, is_off & (np.abs(pulls) > FALSE_SIGMAS)
    return sums | {"is_false": bool(is_off.any())}


def _longest_run(is_found: Bool) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_found.astype(int), [0]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))


Statistic = Callable[[Sequence[FrameScore]], float]


def _share(above: Callable[[FrameScore], float], below: Callable[[FrameScore], float]) -> Statistic:
    def of(scores: Sequence[FrameScore]) -> float:
        total = sum(map(below, scores))
        return sum(map(above, scores)) / total if total else math.nan

    return of


def _root_mean(values: Callable[[FrameScore], Float64 | tuple[()]]) -> Statistic:
    def of(scores: Sequence[FrameScore]) -> float:
        every = np.concatenate([np.atleast_1d(values(score)) for score in scores] or [np.empty(0)])
        return float(np.sqrt(np.mean(np.square(every)))) if len(every) else math.nan

    return of


def _bias(scores: Sequence[FrameScore]) -> float:
    every = np.concatenate([np.asarray(score.errors_px, dtype=float) for score in scores])
    return float(np.mean(every)) if len(every) else math.nan


def _axis(axis: int) -> Callable[[FrameScore], Float64 | tuple[()]]:
    def of(score: FrameScore) -> Float64 | tuple[()]:
        return () if score.is_false or not len(score.seam_mm) else np.asarray(score.seam_mm)[axis : axis + 1]

    return of


def _median_cost(scores: Sequence[FrameScore]) -> float:
    costs = [score.cost for score in scores if not math.isnan(score.cost)]
    return float(np.median(costs)) if costs else math.nan


STRIPE: dict[str, Statistic] = {
    "found": _share(lambda s: s.found, lambda s: s.lines),
    "gross": _share(lambda s: s.gross, lambda s: s.lines),
    "false": _share(lambda s: s.false_lines, lambda s: s.lines),
    "RMS px": _root_mean(lambda s: s.errors_px),
    "bias px": _bias,
    "error/σ": _root_mean(lambda s: np.clip(s.pulls, -10.0, 10.0)),
    "continuity": _share(lambda s: s.run, lambda s: s.lines),
    "IoU": _share(lambda s: s.inter_px, lambda s: s.union_px),
    "CPU": _median_cost,
}
"""Figures of a stripe; errors and CPU apart they are shares of the lines that show one."""

SEAM: dict[str, Statistic] = {
    "valid": _share(lambda s: s.is_valid and s.has_seam, lambda s: s.has_seam),
    "false": _share(lambda s: s.is_false, lambda s: s.is_valid),
    "RMS y mm": _root_mean(_axis(0)),
    "RMS z mm": _root_mean(_axis(1)),
    "error/σ": _root_mean(lambda s: np.clip(s.seam_pulls, -10.0, 10.0)),
    "CPU": _median_cost,
}
"""Figures of a seam: shares of the frames with a joint, of the valid ones; errors of those not false."""


def figures(
    scenes: Sequence[Sequence[FrameScore]], statistics: dict[str, Statistic]
) -> Iterator[tuple[str, BenchFigure]]:
    """Yield each figure with its interval: 95 % of as many scenes drawn with replacement (Efron 1979)."""
    draw = np.random.default_rng(SEED)
    places = draw.integers(len(scenes), size=(DRAWS, len(scenes)))
    for name, statistic in statistics.items():
        value = statistic([score for scene in scenes for score in scene])
        drawn = [statistic([score for n in row for score in scenes[n]]) for row in places]
        known = np.array([each for each in drawn if not math.isnan(each)])
        low, high = np.quantile(known, [0.025, 0.975]).tolist() if len(known) else (math.nan, math.nan)
        yield name, BenchFigure(value, low, high)
