"""The frames that were held back, pixel by pixel before and after: the gap as anyone may recompute it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from noise_model.arrays import Bool, Float32, Float64, Integers
from noise_model.effects import apply_setup_effects
from noise_model.forward import Prediction, Renderer, predict
from noise_model.instrument.sensor import saturation_dn
from noise_model.setup import Setup
from sim_to_real.data.binned import FLOOR_DN, FLOOR_REL, Observed, ObservedFrame
from sim_to_real.data.blocks import cut, off_faces, within
from sim_to_real.diagnosis import Gap, Predicted
from sim_to_real.fit.gauss_newton import FLICKER, Refit
from sim_to_real.fit.linearized_model import Effects, Expected
from sim_to_real.fit.nuisances import really_lit, really_there
from sim_to_real.fit.trend import effects_in

EDGE_PX = 6
"""So far from an edge of the joint or of a shadow a pixel counts."""

STEEP = 0.1
"""A shadow's edge: the arc's light changes by more than this share from pixel to pixel."""

LEVEL_ROUNDS = 3
"""How often a frame's own level of the arc is refined."""

SMOOTH_PX = 4.0
"""1 sigma over which the map of the gap is smoothed."""

LEVEL_STEP = 0.01
"""Step of the derivative with that level."""

BLOCK_PX = 40
"""The side of the blocks that are drawn again and again for an interval."""

DRAWS = 400
"""How often."""

ENDS = 2.5, 97.5
"""The ends of a 95 % interval, percent of the draws."""

CHANCE_SIGMAS = 3.0
"""By so many sigmas a sum of squares may be off by chance."""

MOST_SQUARE = 25.0
"""The largest square of a residual that counts when it is asked whether an effect helps: a streak is none."""


def predict_held(
    held: Observed,
    expected: Expected,
    before: tuple[Refit, Effects],
    after: tuple[Refit, Effects],
    on_frame: Callable[[float], None],
) -> Predicted:
    """Return held-out frames as two fits predict them, each with random effects besides.

    Where both scatter alike, the variance of both is that of the second prediction, the better one: the gap
    before and after is then in the same sigmas.
    """

    def predicted(frame: ObservedFrame) -> tuple[Prediction, Prediction, Bool]:
        renderer = Renderer(2)
        first = _predict(held.setup, expected, frame, *before, renderer)
        second = first if after == before else _predict(held.setup, expected, frame, *after, renderer)
        return first, second, _counts(held.setup, expected, frame, after[0], (first, second), renderer)

    found = []
    for n, of_frame in enumerate(expected.at_once(predicted, held.frames)):
        found.append(of_frame)
        on_frame((n + 1.0) / len(held.frames))
    counts = [counts for _, _, counts in found]
    variance_after = _variances([second for _, second, _ in found], counts)
    scatter_alike = before[1] == after[1]
    return Predicted(
        np.array([frame.index for frame in held.frames]),
        np.array([frame.image_dn for frame in held.frames]),
        np.array([first.mean_dn for first, _, _ in found], dtype=np.float32),
        np.array([second.mean_dn for _, second, _ in found], dtype=np.float32),
        variance_after if scatter_alike else _variances([first for first, _, _ in found], counts),
        variance_after,
    )


def left_in_pixels(aside: Observed, expected: Expected, fits: Sequence[Refit], random: Effects) -> Float64:
    """Return what fits (n,) leave in pixels of other frames, over what the model's floor would leave.

    It is the mean product of the residuals of neighbours, along rows and columns: noise that is not as stated
    has none. Each of `fits` is predicted with the effects that scatter besides. Of few pixels such a mean is
    off by chance: that much is no gap either.
    """

    def sums(frame: ObservedFrame) -> Float64:
        renderer = Renderer(len(fits))
        found = [_predict(aside.setup, expected, frame, fitted, random, renderer) for fitted in fits]
        counts = _counts(aside.setup, expected, frame, fits[0], found, renderer)
        light_dn = found[0].mean_dn - aside.setup.sensor.black_level_dn
        floor = np.hypot(FLOOR_REL * light_dn, FLOOR_DN)
        left = [_alike(frame.image_dn - one.mean_dn, one.variance_dn2, counts) for one in found]
        return np.array([*left, _alike(floor, found[0].variance_dn2, counts), counts.sum()])

    of_all = np.sum(list(expected.at_once(sums, aside.frames)), axis=0)
    # Each pixel has two neighbours to make a product with, of variance 1 if they are noise.
    by_chance = CHANCE_SIGMAS * np.sqrt(0.5 * of_all[-1])
    return np.asarray(of_all[:-2] / (of_all[-2] + by_chance))


def _alike(of_dn: Float64, variance: Float64, counts: Bool) -> float:
    """Return the sum over pixels (H, W) of the mean product with the next ones in row and column."""
    limit = np.sqrt(MOST_SQUARE)
    r = np.where(counts, np.clip(of_dn / np.sqrt(np.where(counts, variance, 1.0)), -limit, limit), 0.0)
    return 0.5 * float(np.sum(r[1:] * r[:-1]) + np.sum(r[:, 1:] * r[:, :-1]))


def _variances(of: Sequence[Prediction], counts: Sequence[Bool]) -> Float32:
    return np.array(
        [np.where(use, one.variance_dn2, np.inf) for one, use in zip(of, counts, strict=True)],
        dtype=np.float32,
    )


def _stated(setup: Setup, fitted: Refit, frame: ObservedFrame) -> Setup:
    effects = effects_in(fitted.effects, fitted.change, setup, frame)
    return replace(really_there(setup, fitted.nuisance), effects={**setup.effects, **effects})


def _predict(
    setup: Setup,
    expected: Expected,
    frame: ObservedFrame,
    fitted: Refit,
    random: Effects,
    renderer: Renderer,
) -> Prediction:
    stated = _stated(setup, fitted, frame)
    stated = replace(stated, effects={**stated.effects, **random})
    pose = frame.T_base_tool_in(stated)
    seam = expected.seam(frame, fitted.nuisance, fitted.effects)
    condition = really_lit(frame.condition, fitted.nuisance)
    found = predict(stated, pose, condition, seam=seam, renderer=renderer)
    if FLICKER not in fitted.ids or condition.arc_level == 0.0:
        return found

    def at(level: float) -> Prediction:
        lit = replace(condition, arc_level=condition.arc_level * level)
        return predict(stated, pose, lit, seam=seam, renderer=renderer)

    return _with_own_level(frame.image_dn, at)


def _with_own_level(recorded: Integers, at: Callable[[float], Prediction]) -> Prediction:
    """Return a frame with the arc's own level: of every other block for those between, and the other way."""
    height, width = recorded.shape
    row, column = np.mgrid[:height, :width] // BLOCK_PX
    is_even = (row + column) % 2 == 0
    levels = []
    for of in (is_even, ~is_even):
        level = 1.0
        for _ in range(LEVEL_ROUNDS):
            here, there = at(level), at(level * (1.0 + LEVEL_STEP))
            slope = (there.mean_dn - here.mean_dn)[of] / LEVEL_STEP
            weight = np.where(here.saturated, 0.0, 1.0 / here.variance_dn2)[of]
            gain = np.sum(weight * slope * (recorded - here.mean_dn)[of])
            level *= float(np.clip(1.0 + gain / max(np.sum(weight * slope**2), 1e-12), 0.5, 2.0))
        levels.append(level)
    of_odd, of_even = at(levels[1]), at(levels[0])
    return replace(
        of_even,
        mean_dn=np.where(is_even, of_odd.mean_dn, of_even.mean_dn),
        variance_dn2=np.where(is_even, of_odd.variance_dn2, of_even.variance_dn2),
    )


def _counts(
    setup: Setup,
    expected: Expected,
    frame: ObservedFrame,
    fitted: Refit,
    predicted: Sequence[Prediction],
    renderer: Renderer,
) -> Bool:
    """Return the pixels (H, W) that count: on one face, off shadows' edges, not saturated.

    What is predicted to be saturated has no spread of its own to be measured by.
    """
    true = apply_setup_effects(_stated(setup, fitted, frame))
    pose = frame.T_base_tool_in(true)
    layers = renderer.layers(true, pose, expected.seam(frame, fitted.nuisance, fitted.effects))
    bad = off_faces(layers.faces, 2 * EDGE_PX + 1)
    if frame.condition.arc_level > 0.0:
        arc = layers.arc_e
        steep = np.maximum(*(np.abs(np.gradient(arc, axis=axis)) for axis in (0, 1))) > STEEP * arc
        bad |= within(steep & (arc > 0.0), 2 * EDGE_PX + 1)
    for one in predicted:
        bad |= one.saturated
    return ~bad & ~within(frame.image_dn >= saturation_dn(setup.sensor), 3)


def measure(predicted: Predicted, setup: Setup, seam_mm: tuple[float, float], seed: int = 0) -> Gap:
    """Measure the gap: sqrt(mean r^2 - 1) of the pixels that count, its interval by blocks drawn again.

    `seam_mm` is passed on: how far the seam point moves before and after.
    """
    counts = np.isfinite(predicted.variance)
    light_dn = predicted.after.astype(np.float64) - setup.sensor.black_level_dn
    squares = np.stack(
        [
            _squares(predicted.recorded - predicted.before, predicted.variance, counts),
            _squares(predicted.recorded - predicted.after, predicted.variance_after, counts),
            _squares(np.hypot(FLOOR_REL * light_dn, FLOOR_DN), predicted.variance_after, counts),
            counts.astype(np.float64),
        ]
    )
    # What a model is off by comes back at a place in every frame: a draw takes a place in all of them.
    blocks = cut(squares.sum(axis=1), BLOCK_PX).sum(axis=(-3, -1)).reshape(len(squares), -1)
    before, after, floor = _gaps(squares.sum(axis=(1, 2, 3)))
    draws = np.random.default_rng(seed).integers(0, blocks.shape[1], (DRAWS, blocks.shape[1]))
    drawn = np.array([_closed(*_gaps(blocks[:, draw].sum(axis=1))) for draw in draws])
    # Where more draws than an end leaves out have no gap above the floor the share has no bounds.
    is_bounded = 100.0 * np.mean(np.isnan(drawn)) < ENDS[0]
    low, high = np.nanpercentile(drawn, ENDS) if is_bounded else (np.nan, np.nan)
    rms = [
        float(np.sqrt(np.mean((predicted.recorded - mean)[counts] ** 2)))
        for mean in (predicted.before, predicted.after)
    ]
    closed = _closed(before, after, floor)
    return Gap(before, after, floor, closed, (float(low), float(high)), (rms[0], rms[1]), seam_mm)


def smaller(predicted: Predicted, seed: int = 0) -> float:
    """Return in which share of draws of their blocks the residuals are smaller after than before."""
    counts = np.isfinite(predicted.variance)
    before, after = (
        np.minimum(_squares(predicted.recorded - mean, predicted.variance, counts), MOST_SQUARE)
        for mean in (predicted.before, predicted.after)
    )
    blocks = cut((before - after).sum(axis=0), BLOCK_PX).sum(axis=(-3, -1)).ravel()
    draws = np.random.default_rng(seed).integers(0, len(blocks), (DRAWS, len(blocks)))
    return float(np.mean(blocks[draws].sum(axis=1) > 0.0))


def _squares(of_dn: Float64 | Float32, variance: Float64 | Float32, counts: Bool) -> Float64:
    return np.where(counts, np.square(of_dn, dtype=np.float64) / np.where(counts, variance, 1.0), 0.0)


def _gaps(sums: Float64) -> tuple[float, float, float]:
    """Return before, after and floor of the sums (4,) of their squares and of the counts."""
    if sums[3] == 0.0:
        return np.nan, np.nan, np.nan
    before, after, floor = sums[:3] / sums[3]
    return (
        float(np.sqrt(max(before - 1.0, 0.0))),
        float(np.sqrt(max(after - 1.0, 0.0))),
        float(np.sqrt(floor)),
    )


def _closed(before: float, after: float, floor: float) -> float:
    """Return (before - after) / (before - floor); NaN where there is no gap above the floor."""
    return (before - after) / (before - floor) if before > floor else np.nan


def excess_map(predicted: Predicted) -> Float32:
    """Return by how many sigmas the residual exceeds its noise (H, W), smoothed, signed as its mean."""
    counts = np.isfinite(predicted.variance)
    sigma = np.sqrt(np.where(counts, predicted.variance, 1.0))
    r = np.where(counts, (predicted.recorded - predicted.before) / sigma, 0.0)
    weight, first, second = (
        cv2.GaussianBlur(image.sum(axis=0).astype(np.float32), (0, 0), SMOOTH_PX)
        for image in (counts, r, r**2)
    )
    seen = weight > 0.1
    with np.errstate(invalid="ignore", divide="ignore"):
        excess = np.sqrt(np.maximum(second / weight - 1.0, 0.0)) * np.sign(first)
    return np.where(seen, excess, np.nan).astype(np.float32)
