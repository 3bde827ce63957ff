"""Diagnoses made by hand from predicted and drawn frames, for the tests of what is written about them."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from made import level_pose

from noise_model.condition import Condition
from noise_model.effects import REGISTRY, checked
from noise_model.forward import draw_frame, predict
from noise_model.setup import Setup
from sim_to_real.diagnosis import (
    Curve,
    Diagnosis,
    DiagnosisVerdict,
    EffectCost,
    Gap,
    HeldOutPrediction,
    ModelTest,
    NamedEffect,
    Next,
    ParameterEstimate,
    RankedEffect,
    Reason,
    SeamShift,
    UnknownDescription,
    UnknownTerm,
    Where,
)

GAMMA = {"gamma": {"gamma": 0.74}}
GLARE = {"veiling_glare": {"share": 0.15, "spread": 0.6}}
DELAY = {"pose_delay": {"delay_s": 0.031}}

Effects = Mapping[str, Mapping[str, float]]


def example(verdict: DiagnosisVerdict, setup: Setup, effects: Effects = GAMMA) -> Diagnosis:
    """Return a diagnosis whose images really show the effects, and whose gap is that of its images."""
    really = {} if verdict is DiagnosisVerdict.NO_GAP else effects
    found = {} if verdict is DiagnosisVerdict.UNKNOWN else really
    predicted = predicted_frames(setup, really, found)
    before = gap_of(predicted.recorded, predicted.before, predicted.variance)
    after = gap_of(predicted.recorded, predicted.after, predicted.variance_after)
    is_gap = verdict is not DiagnosisVerdict.NO_GAP
    stage = REGISTRY[next(iter(effects))].stage.value
    named = [
        NamedEffect(name, REGISTRY[name].stage.value, 0.997, 1.0 / len(effects), estimates(name, values))
        for name, values in effects.items()
    ]
    return Diagnosis(
        verdict=verdict,
        effects=tuple(named) if verdict in (DiagnosisVerdict.EFFECTS, DiagnosisVerdict.AMBIGUOUS) else (),
        ranking=ranking(effects, verdict),
        ambiguous_with=((next(iter(effects)), "black_level"),)
        if verdict is DiagnosisVerdict.AMBIGUOUS
        else (),
        gap=Gap(
            before,
            after,
            0.3,
            (before - after) / (before - 0.3) if is_gap else math.nan,
            (0.94, 0.97) if is_gap else (math.nan, math.nan),
            (rms(predicted.recorded, predicted.before), rms(predicted.recorded, predicted.after)),
            (0.21, 0.05) if is_gap else (0.01, 0.01),
            1.0 if is_gap else 0.5,
        ),
        where=where(predicted, stage, is_gap),
        next=Next("two exposures, arc off", (next(iter(effects)), "exposure_drift"), True)
        if is_gap
        else None,
        not_resolvable=(("wrong_material", "fume"), ("arc_length", "arc_radius")),
        smallest={
            "gamma": ParameterEstimate(0.02, math.nan, ""),
            "arc_length": ParameterEstimate(0.3, math.nan, "mm"),
        },
        left_over=("half_angle times_arc", 0.62) if verdict is DiagnosisVerdict.UNKNOWN else None,
        after_with=() if verdict is DiagnosisVerdict.NO_GAP else tuple(effects),
        predicted=predicted,
        model_test=model_test(is_gap),
        reasons=reasons(next(iter(effects)), verdict),
        costs=costs(effects, verdict),
        unknown=unknown_cause() if verdict is DiagnosisVerdict.UNKNOWN else None,
    )


def model_test(is_gap: bool) -> ModelTest:
    p_values = {"held_out_gap": 0.3, "bins": 0.6, "scatter": 0.5}
    return ModelTest(3e-9, {**p_values, "bins": 1e-9}) if is_gap else ModelTest(0.657, p_values)


def costs(effects: Effects, verdict: DiagnosisVerdict) -> tuple[EffectCost, ...]:
    """Return what effects cost, and a bound of one that was not found."""
    unknown = SeamShift(math.nan, math.nan, math.nan, math.nan)
    bound = SeamShift(math.nan, 0.0, 0.014, math.nan)
    found = () if verdict in (DiagnosisVerdict.NO_GAP, DiagnosisVerdict.UNKNOWN) else tuple(effects)
    shifts = SeamShift(0.0013, 0.0012, 0.0014, -0.001), SeamShift(0.2117, 0.2, 0.2213, 0.21)
    return (
        *(EffectCost(name, *shifts, 4, 1, effects[name], is_named=True) for name in found),
        EffectCost("read_noise", unknown, unknown, 0, 0, {"noise_ratio": 1.2}, is_rendered=False),
        EffectCost("arc_length", SeamShift(math.nan, 0.0, 0.0002, math.nan), bound, 1, 0, {}, is_bound=True),
    )


def unknown_cause() -> UnknownDescription:
    """Return an unknown cause that goes with the distance from the arc, in two of nine frames."""
    terms = (
        UnknownTerm(
            "medium",
            "arc over the distance",
            "distance",
            "arc",
            "arc light by distance",
            90.0,
            0.1,
            0.97,
            0.8,
        ),
        UnknownTerm(
            "optics", "light over the image", "image", "laser and arc", "light by place", 60.0, 0.1, 0.02, 0.4
        ),
    )
    centers = np.linspace(20.0, 60.0, 9)
    mean = 0.1 * np.cos((centers - 20.0) / 40.0 * math.pi)
    return UnknownDescription(
        terms=terms,
        curve=Curve("distance", "mm", 0.62, "times_arc", 80.0, centers, mean, mean - 0.02, mean + 0.02),
        rows_px=(20.0, 60.0),
        columns_px=(40.0, 80.0),
        along_mm=(12.0, 18.0),
        aside_mm=(-4.0, 3.0),
        spread=0.08,
        frames=(2, 7),
        n_frames=9,
        excess=2.4,
        seam_off_mm=(0.31, -1.2),
        sheet_mm=-0.44,
    )


def reasons(name: str, verdict: DiagnosisVerdict) -> tuple[Reason, ...]:
    """Return what was compared: an effect, an unknown cause, and no gap."""
    if verdict is DiagnosisVerdict.NO_GAP:
        return (Reason("no gap", (), 0.0, 0.0, 0.99), Reason(name, (name,), -2.0, 0.0, 0.01))
    cause, best = "unknown: sensor, grey level", 340.0
    nats = {name: 310.0, cause: best} if verdict is DiagnosisVerdict.UNKNOWN else {name: best, cause: 310.0}
    compared = [
        Reason(key, (key,) if key == name else (), value, best, float(value == best))
        for key, value in nats.items()
    ]
    compared.sort(key=lambda reason: -reason.evidence)
    return (*compared, Reason("no gap", (), 0.0, best, 0.0))


def estimates(name: str, values: Mapping[str, float]) -> dict[str, ParameterEstimate]:
    units = {parameter.name: parameter.unit for parameter in REGISTRY[name].parameters}
    complete = REGISTRY[name].complete(values)
    return {
        key: ParameterEstimate(value, max(0.01 * abs(value), 1e-3), units[key])
        for key, value in complete.items()
    }


def ranking(effects: Effects, verdict: DiagnosisVerdict) -> tuple[RankedEffect, ...]:
    closed = {DiagnosisVerdict.NO_GAP: 0.0, DiagnosisVerdict.UNKNOWN: 0.22}.get(verdict, 0.96)
    others = ("black_level", "exposure_drift", "hot_metal_glow", "fume", "vignetting", "arc_length")
    best = [RankedEffect(name, 0.9 / len(effects), closed, left_sigma=3.0 - 3.0 * closed) for name in effects]
    worse = [
        RankedEffect(name, 0.4**n / 9.0, closed * 0.8**n, left_sigma=3.0 - 3.0 * closed * 0.8**n)
        for n, name in enumerate(others, 1)
    ]
    # Random effects are there or not, whatever else is.
    random = [
        RankedEffect(name, p, 0.0, is_random=True) for name, p in (("read_noise", 0.95), ("spatter", 0.02))
    ]
    return (*best, *worse, *random)


def predicted_frames(setup: Setup, really: Effects, found: Effects) -> HeldOutPrediction:
    rng = np.random.default_rng(5)
    changed, fitted = (replace(setup, effects=checked(effects)) for effects in (really, found))
    exposure_s = setup.camera.exposure_s
    recorded, before, after, variance, variance_after = [], [], [], [], []
    for n, (laser, arc) in enumerate(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0))):
        condition = Condition(laser, arc, exposure_s, 0.1 * n)
        T_base_tool = level_pose(0.1 * n)
        recorded.append(draw_frame(changed, T_base_tool, condition, rng))
        for of_setup, mean, spread in ((setup, before, variance), (fitted, after, variance_after)):
            frame = predict(of_setup, T_base_tool, condition)
            mean.append(frame.mean_dn)
            spread.append(np.where(frame.saturated, np.inf, frame.variance_dn2))
    arrays = (np.array(part, dtype=np.float32) for part in (before, after, variance, variance_after))
    return HeldOutPrediction(np.array([3, 7, 11, 15]), np.array(recorded), *arrays)


def where(predicted: HeldOutPrediction, stage: str, is_gap: bool) -> Where:
    r = (predicted.recorded - predicted.before) / np.sqrt(predicted.variance)
    z = r.sum(axis=0) / math.sqrt(len(r))
    z[np.isinf(predicted.variance).any(axis=0)] = np.nan
    centers = np.linspace(5.0, 200.0, 12)
    size = 4.0 if is_gap else 0.1
    mean = size * np.sin(centers / 60.0)
    curve = Curve("gray_level", "DN", 0.81, "adds", 340.0, centers, mean, mean - 0.4, mean + 0.4)
    signs, shares = np.array([-1.0, 1.0]), np.array([-0.1, 0.1])
    weave = Curve("velocity_sign", "", 0.14, "times_arc", 31.0, signs, shares, shares - 0.02, shares + 0.02)
    return Where(
        stage=stage,
        stages={stage: 0.96, "timing": 0.035, "geometry": 0.005},
        covariates=(curve, weave),
        image={"row": 0.1, "radial": 0.24, "fixed": 0.36, "stripe_band": math.nan},
        strata={"dark": 0.0, "laser": 0.9, "arc": size, "both": 3.0, "stripe_band": math.nan},
        z=z.astype(np.float32),
    )


def gap_of(recorded: np.ndarray, mean: np.ndarray, variance: np.ndarray) -> float:
    counts = np.isfinite(variance)
    r2 = (recorded - mean)[counts] ** 2 / variance[counts]
    return math.sqrt(max(float(r2.mean(dtype=np.float64)) - 1.0, 0.0))


def rms(recorded: np.ndarray, mean: np.ndarray) -> float:
    return float(np.sqrt(np.mean((recorded - mean) ** 2)))
