"""The gap on held-out frames, pixel by pixel, before and after a fit; stored predictions suffice for it."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from noise_model.compiled.arrays import Bool, Float32, Float64, Integers
from noise_model.condition import Condition
from noise_model.effects import Effects, apply_setup_effects
from noise_model.forward import Prediction, Renderer, predict
from noise_model.instrument.sensor import respond, saturation_dn
from noise_model.setup import Setup
from sim_to_real.data.binned import FLOOR_DN, FLOOR_REL, ObservedFrame, ObservedRecording
from sim_to_real.data.blocks import dilate, in_blocks, near_face_edges
from sim_to_real.decision.seam_error import UNKNOWN_ERRORS, SeamErrors
from sim_to_real.diagnosis import Gap, HeldOutPrediction
from sim_to_real.fit.gauss_newton import FLICKER, Refit
from sim_to_real.fit.linearized_model import INTERREFLECTION, LinearizedModel
from sim_to_real.fit.nuisances import apply_levels, apply_nuisances
from sim_to_real.fit.trend import effects_in_frame

EDGE_PX = 6
"""Pixels nearer to an edge of the joint or of a shadow do not count."""

BLOCK_PX = 40
"""The side of the blocks that are resampled for an interval."""


def predict_holdout(
    holdout: ObservedRecording,
    model: LinearizedModel,
    before: tuple[Refit, Effects],
    after: tuple[Refit, Effects],
    on_frame: Callable[[float], None],
) -> HeldOutPrediction:
    """Return held-out frames as two fits predict them, each with its random effects.

    If both have the same random effects, both variances are the second prediction's, the better one: the gap
    before and after is then in the same sigmas.
    """

    def predicted(frame: ObservedFrame) -> tuple[Prediction, Prediction, Bool]:
        renderer = Renderer(2)
        first = _predict(holdout.setup, model, frame, *before, renderer)
        second = first if after == before else _predict(holdout.setup, model, frame, *after, renderer)
        return first, second, _valid_pixels(holdout.setup, model, frame, after[0], (first, second), renderer)

    predictions = []
    for n, both in enumerate(model.in_parallel(predicted, holdout.frames)):
        predictions.append(both)
        on_frame((n + 1.0) / len(holdout.frames))
    counts = [counts for _, _, counts in predictions]
    variance_after = _variances([second for _, second, _ in predictions], counts)
    same_random = before[1] == after[1]
    return HeldOutPrediction(
        np.array([frame.index for frame in holdout.frames]),
        np.array([frame.image_dn for frame in holdout.frames]),
        np.array([first.mean_dn for first, _, _ in predictions], dtype=np.float32),
        np.array([second.mean_dn for _, second, _ in predictions], dtype=np.float32),
        variance_after if same_random else _variances([first for first, _, _ in predictions], counts),
        variance_after,
    )


def combined_predictions(
    first: HeldOutPrediction, second: HeldOutPrediction, same_random: bool
) -> HeldOutPrediction:
    """Return the same frames by two setups: before as the first predicts them, after as the second does.

    Pixels count that count in both. If both have the `same_random` effects, all are in the sigmas of the
    prediction that is nearer to the frames.
    """
    counts = np.isfinite(first.variance) & np.isfinite(second.variance_after)
    apart = [np.where(counts, np.abs(fit.recorded - fit.after), 0.0).sum() for fit in (first, second)]
    nearer = first.variance if apart[0] < apart[1] else second.variance_after
    before, after = (nearer, nearer) if same_random else (first.variance, second.variance_after)
    inf = np.float32(np.inf)
    return HeldOutPrediction(
        first.frames,
        first.recorded,
        first.before,
        second.after,
        np.where(counts, before, inf),
        np.where(counts, after, inf),
    )


def _variances(predictions: Sequence[Prediction], counts: Sequence[Bool]) -> Float32:
    pairs = zip(predictions, counts, strict=True)
    return np.array(
        [np.where(use, prediction.variance_dn2, np.inf) for prediction, use in pairs], dtype=np.float32
    )


def _setup_of_fit(setup: Setup, fitted: Refit, frame: ObservedFrame) -> Setup:
    effects = effects_in_frame(fitted.effects, fitted.trend, setup, frame)
    return replace(apply_nuisances(setup, fitted.nuisance), effects={**setup.effects, **effects})


def _predict(
    setup: Setup,
    model: LinearizedModel,
    frame: ObservedFrame,
    fitted: Refit,
    random: Effects,
    renderer: Renderer,
) -> Prediction:
    stated = _setup_of_fit(setup, fitted, frame)
    stated = replace(stated, effects={**stated.effects, **random})
    pose = frame.T_base_tool_in(stated)
    seam = model.renderings.seam(frame, fitted.nuisance, fitted.effects)
    condition = apply_levels(frame.condition, fitted.nuisance)
    if INTERREFLECTION in stated.effects:
        view = renderer.layers(apply_setup_effects(stated), pose, seam).view
        model.keep_bounced(frame, view)
    prediction = predict(stated, pose, condition, seam=seam, renderer=renderer)
    bend_dn2 = _bend_variance_dn2(model, frame, fitted, prediction, stated, condition)
    prediction = replace(prediction, variance_dn2=prediction.variance_dn2 + bend_dn2)
    if FLICKER not in fitted.ids or condition.arc_level == 0.0:
        return prediction

    def predict_at(arc_level: float) -> Prediction:
        lit = replace(condition, arc_level=condition.arc_level * arc_level)
        return predict(stated, pose, lit, seam=seam, renderer=renderer)

    return _with_own_level(frame.image_dn, predict_at)


def _bend_variance_dn2(
    model: LinearizedModel,
    frame: ObservedFrame,
    fitted: Refit,
    prediction: Prediction,
    stated: Setup,
    condition: Condition,
) -> Float64:
    """Return the variance (H, W) of the arc's light past edges that bend, as in the fit."""
    spread_e = model.bend_spread_e(frame, np.arange(frame.keep.size), fitted.nuisance, fitted.effects)
    # A pixel at the rim that fills no bin takes that of the last one.
    last = [n - 1 for n in frame.keep.shape]
    rows, columns = (
        np.minimum(np.arange(n) // model.observed.bin_px, n_bins)
        for n, n_bins in zip(prediction.mean_e.shape, last, strict=True)
    )
    of_pixels_e = spread_e.reshape(frame.keep.shape)[np.ix_(rows, columns)]
    level = condition.arc_level * condition.exposure_s / stated.camera.exposure_s
    step_dn = respond(prediction.mean_e + 1.0, stated.sensor) - respond(prediction.mean_e, stated.sensor)
    return np.square(level * step_dn * of_pixels_e)


def _with_own_level(recorded: Integers, predict_at: Callable[[float], Prediction]) -> Prediction:
    """Return a frame with its own arc level, cross-validated on two halves of a chequerboard of blocks."""
    height, width = recorded.shape
    row, column = np.mgrid[:height, :width] // BLOCK_PX
    is_even = (row + column) % 2 == 0
    levels = []
    for block_half in (is_even, ~is_even):
        level = 1.0
        for _ in range(3):
            step = 0.01
            here, there = predict_at(level), predict_at(level * (1.0 + step))
            slope = (there.mean_dn - here.mean_dn)[block_half] / step
            weight = np.where(here.saturated, 0.0, 1.0 / here.variance_dn2)[block_half]
            gain = np.sum(weight * slope * (recorded - here.mean_dn)[block_half])
            level *= float(np.clip(1.0 + gain / max(np.sum(weight * slope**2), 1e-12), 0.5, 2.0))
        levels.append(level)
    of_odd, of_even = predict_at(levels[1]), predict_at(levels[0])
    return replace(
        of_even,
        mean_dn=np.where(is_even, of_odd.mean_dn, of_even.mean_dn),
        variance_dn2=np.where(is_even, of_odd.variance_dn2, of_even.variance_dn2),
    )


def _valid_pixels(
    setup: Setup,
    model: LinearizedModel,
    frame: ObservedFrame,
    fitted: Refit,
    predicted: Sequence[Prediction],
    renderer: Renderer,
) -> Bool:
    """Return the pixels (H, W) that count: on one face, off shadows' edges, not saturated.

    A pixel that is predicted to be saturated has no noise to measure its residual by.
    """
    true = apply_setup_effects(_setup_of_fit(setup, fitted, frame))
    pose = frame.T_base_tool_in(true)
    layers = renderer.layers(true, pose, model.renderings.seam(frame, fitted.nuisance, fitted.effects))
    bad = near_face_edges(layers.faces, 2 * EDGE_PX + 1)
    if frame.condition.arc_level > 0.0:
        arc = layers.arc_e
        # At a shadow's edge the light changes by more than a tenth from pixel to pixel.
        steep = np.maximum(*(np.abs(np.gradient(arc, axis=axis)) for axis in (0, 1))) > 0.1 * arc
        bad |= dilate(steep & (arc > 0.0), 2 * EDGE_PX + 1)
    for prediction in predicted:
        bad |= prediction.saturated
    return ~bad & ~dilate(frame.image_dn >= saturation_dn(setup.sensor), 3)


def measure_gap(
    predicted: HeldOutPrediction, setup: Setup, seam: SeamErrors = UNKNOWN_ERRORS, seed: int = 0
) -> Gap:
    """Measure the gap, sqrt(mean r^2 - 1) of the pixels that count, with its interval by a block bootstrap.

    `seam`, the seam's errors before and after, is passed on.
    """
    counts = np.isfinite(predicted.variance)
    # A model's error recurs at a place in every frame: a draw takes a block in all of them.
    squares = _squares_over_frames(predicted, counts, setup.sensor.black_level_dn)
    blocks = in_blocks(squares, BLOCK_PX).sum(axis=(-3, -1)).reshape(len(squares), -1)
    before, after, floor = _gaps(squares.sum(axis=(1, 2)))
    # Draws of the bootstrap.
    draws = np.random.default_rng(seed).integers(0, blocks.shape[1], (400, blocks.shape[1]))
    sums = blocks[:, draws].sum(axis=2)
    drawn = np.array([_closed_share(*_gaps(of_draw)) for of_draw in sums.T])
    p_nearer = float(np.mean(sums[1] < sums[4])) if counts.any() else np.nan
    # If more draws than an end leaves out have no gap above the floor, the share has no bounds.
    ends = 2.5, 97.5
    is_bounded = 100.0 * np.mean(np.isnan(drawn)) < ends[0]
    low, high = np.nanpercentile(drawn, ends) if is_bounded else (np.nan, np.nan)
    rms = [
        float(np.sqrt(np.mean((predicted.recorded - mean)[counts] ** 2)))
        for mean in (predicted.before, predicted.after)
    ]
    closed = _closed_share(before, after, floor)
    return Gap(
        before,
        after,
        floor,
        closed,
        ci95=(float(low), float(high)),
        rms_dn=(rms[0], rms[1]),
        seam_mm=seam.total_mm,
        p_nearer=p_nearer,
        seam_lateral_mm=seam.lateral_mm,
        seam_vertical_mm=seam.vertical_mm,
    )


def _squares_over_frames(predicted: HeldOutPrediction, counts: Bool, black_level_dn: float) -> Float64:
    """Return whitened squares (5, H, W), each the sum over all frames of the pixels that count.

    They are those of the residuals before, after, and of the model's floor, then the number of pixels, and
    the residuals before in the variance after.
    """
    sums = np.zeros((5, *counts.shape[1:]))
    # Frame by frame: what is held for all of them at once takes longer to reserve than to compute.
    for n, use in enumerate(counts):
        recorded, before, after = predicted.recorded[n], predicted.before[n], predicted.after[n]
        floor_dn = np.hypot(FLOOR_REL * (after.astype(np.float64) - black_level_dn), FLOOR_DN)
        variance_after = predicted.variance_after[n]
        sums[0] += _squares(recorded - before, predicted.variance[n], use)
        sums[1] += _squares(recorded - after, variance_after, use)
        sums[2] += _squares(floor_dn, variance_after, use)
        sums[3] += use
        sums[4] += _squares(recorded - before, variance_after, use)
    return sums


def _squares(residuals_dn: Float64 | Float32, variance: Float64 | Float32, counts: Bool) -> Float64:
    return np.where(counts, np.square(residuals_dn, dtype=np.float64) / np.where(counts, variance, 1.0), 0.0)


def _gaps(sums: Float64) -> tuple[float, float, float]:
    """Return before, after and floor of the sums (5,) of their squares and, fourth, of the counts."""
    if sums[3] == 0.0:
        return np.nan, np.nan, np.nan
    before, after, floor = sums[:3] / sums[3]
    return (
        float(np.sqrt(max(before - 1.0, 0.0))),
        float(np.sqrt(max(after - 1.0, 0.0))),
        float(np.sqrt(floor)),
    )


def _closed_share(before: float, after: float, floor: float) -> float:
    """Return (before - after) / (before - floor), 1 at most; NaN where there is no gap above the floor.

    Below its floor the model tells nothing: a gap that ends there is closed.
    """
    return min((before - after) / (before - floor), 1.0) if before > floor else np.nan


def excess_map(predicted: HeldOutPrediction) -> Float32:
    """Return the smoothed excess (H, W) of residuals over noise, sigmas, with the sign of their mean."""
    counts = np.isfinite(predicted.variance)
    sigma = np.sqrt(np.where(counts, predicted.variance, 1.0))
    r = np.where(counts, (predicted.recorded - predicted.before) / sigma, 0.0)
    # 1 sigma over which the map of the gap is smoothed.
    weight, first, second = (
        cv2.GaussianBlur(image.sum(axis=0).astype(np.float32), (0, 0), 4.0) for image in (counts, r, r**2)
    )
    seen = weight > 0.1
    with np.errstate(invalid="ignore", divide="ignore"):
        excess = np.sqrt(np.maximum(second / weight - 1.0, 0.0)) * np.sign(first)
    return np.where(seen, excess, np.nan).astype(np.float32)
