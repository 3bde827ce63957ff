"""Files of a diagnosis for programs: report.json, where.npz and predicted.npz."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from arctrack.diagnose.pages import unknown_words
from arctrack.output import write_whole, writing
from arctrack.recording.results import FINISHED_JSON
from sim_to_real.diagnosis import (
    Diagnosis,
    EffectCost,
    Gap,
    HeldOutPrediction,
    NamedEffect,
    Next,
    RankedEffect,
    Reason,
    Where,
)

REPORT_JSON, WHERE_NPZ, PREDICTED_NPZ = "report.json", "where.npz", "predicted.npz"
REPORT_PAGE = "report.html"
MADE_FILES = (REPORT_JSON, WHERE_NPZ, PREDICTED_NPZ, REPORT_PAGE)
FILES = (*MADE_FILES, FINISHED_JSON)
"""Every file that a diagnosis writes, the last one when all others are whole."""

ADDED_JSON, ADDED_NPZ, ADDED_PAGE = "applied.json", "applied.npz", "applied.html"
ADDED_FILES = (ADDED_JSON, ADDED_NPZ, ADDED_PAGE)
"""Further files where effects that were found are added to the setup."""

DIGITS, ALL_DIGITS = 6, 17
"""Significant digits of a number in report.json, and those that say a float exactly."""


def write_numbers(diagnosis: Diagnosis, folder: Path, without: Sequence[str] = ()) -> None:
    """Write where.npz, predicted.npz and report.json; who sees report.json finds the arrays whole.

    `without` are the effects that the user left out of the search.

    Raises ArctrackError if one cannot be written.
    """
    z = diagnosis.where.z.astype(np.float32)
    with writing(folder / WHERE_NPZ):
        np.savez_compressed(folder / WHERE_NPZ, z=np.abs(z), sign=np.sign(z))
    write_predictions(diagnosis.predicted, folder / PREDICTED_NPZ)
    write_json(report(diagnosis, without), folder / REPORT_JSON)


def write_predictions(predicted: HeldOutPrediction, path: Path) -> None:
    """Write held-out frames and their predictions as arrays; ArctrackError if they cannot be written."""
    with writing(path):
        np.savez_compressed(
            path,
            frames=predicted.frames,
            before=predicted.before.astype(np.float32),
            after=predicted.after.astype(np.float32),
            variance=predicted.variance.astype(np.float32),
            variance_after=predicted.variance_after.astype(np.float32),
            recorded=predicted.recorded,
        )


def read_predictions(path: Path) -> HeldOutPrediction:
    """Return the held-out frames and predictions that `write_predictions` wrote."""
    with np.load(path) as arrays:
        return HeldOutPrediction(**arrays)


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write a file for programs; ArctrackError if it cannot be written."""
    write_whole(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def report(diagnosis: Diagnosis, without: Sequence[str] = ()) -> dict[str, Any]:
    """Return the content of report.json; what is not known is null."""
    content = {
        "format": "arctrack-diagnosis/1",
        "verdict": diagnosis.verdict.value,
        "effects": [named_effect(effect) for effect in diagnosis.effects],
        "ranking": [_ranked(candidate) for candidate in diagnosis.ranking],
        "ambiguous_with": diagnosis.ambiguous_with,
        "gap": gap_numbers(diagnosis.gap),
        "where": _where(diagnosis.where),
        "next": _next(diagnosis.next),
        "not_resolvable": diagnosis.not_resolvable,
        "smallest_detectable": {name: asdict(least) for name, least in diagnosis.smallest.items()},
        "left_over": _left_over(diagnosis.left_over),
        "after_with": diagnosis.after_with,
        "reasons": [_reason(reason) for reason in diagnosis.reasons],
        "withheld": tuple(without),
        "cost": [cost_content(cost) for cost in diagnosis.costs],
        "model_test": asdict(diagnosis.model_test),
        "unknown": _unknown(diagnosis),
    }
    rounded: dict[str, Any] = plain(content, DIGITS)
    return rounded


def gap_numbers(gap: Gap) -> dict[str, Any]:
    """Return a gap's numbers by name."""
    return {
        "before": gap.before,
        "after": gap.after,
        "floor": gap.floor,
        "closed": gap.closed,
        "ci95": gap.ci95,
        "rms_dn": _before_after(gap.rms_dn),
        "seam_mm": _before_after(gap.seam_mm),
        "p_nearer": gap.p_nearer,
        "seam_lateral_mm": _before_after(gap.seam_lateral_mm),
        "seam_vertical_mm": _before_after(gap.seam_vertical_mm),
    }


def named_effect(effect: NamedEffect) -> dict[str, Any]:
    """Return a named effect's keys."""
    parameters = {name: asdict(estimate) for name, estimate in effect.parameters.items()}
    named = {
        "id": effect.id,
        "stage": effect.stage,
        "confidence": effect.confidence,
        "share": effect.share,
        "parameters": parameters,
    }
    return named if effect.trend is None else {**named, "trend": asdict(effect.trend)}


def _ranked(candidate: RankedEffect) -> dict[str, Any]:
    return {"id": candidate.id, "confidence": candidate.confidence, "gap_closed": candidate.gap_closed}


def cost_content(cost: EffectCost) -> dict[str, Any]:
    """Return an effect's cost as a report has it."""
    return {
        "id": cost.id,
        "lateral_mm": asdict(cost.lateral_mm),
        "vertical_mm": asdict(cost.vertical_mm),
        "named": cost.is_named,
        "bound": cost.is_bound,
        "parameters": cost.values,
        "frames": cost.n_frames,
        "lost": cost.n_lost,
        "flag": None if cost.flag is None else cost.flag.value,
    }


def _reason(reason: Reason) -> dict[str, Any]:
    return {
        "rule": f"evidence of {reason.name}, nats over no gap",
        "value": reason.evidence,
        "limit": reason.best,
        "probability": reason.probability,
        "effects": reason.effects,
    }


def _before_after(values: tuple[float, float]) -> dict[str, float]:
    return dict(zip(("before", "after"), values, strict=True))


def _where(where: Where) -> dict[str, Any]:
    return {
        "stage": where.stage,
        "stages": where.stages,
        "covariates": [
            {"name": curve.name, "r2": curve.r2, "nats": curve.nats, "form": curve.form}
            for curve in where.covariates
        ],
        "strata": where.strata,
        "image": where.image,
        "map": WHERE_NPZ,
    }


def _next(measurement: Next | None) -> dict[str, Any] | None:
    if measurement is None:
        return None
    return {
        "experiment": measurement.experiment,
        "separates": measurement.separates,
        "reason": measurement.reason,
        "certainty": measurement.certainty,
    }


def _unknown(diagnosis: Diagnosis) -> dict[str, Any] | None:
    """Return what is known of an unknown cause, None of a verdict without one."""
    unknown = diagnosis.unknown
    if unknown is None:
        return None
    curve = unknown.curve
    nearest = unknown_words.nearest(diagnosis)
    return {
        "sentences": dict(unknown_words.described(diagnosis)),
        # report.json names the likeliest terms.
        "terms": [
            {name: value for name, value in asdict(term).items() if name not in ("size", "words")}
            for term in unknown.terms[:5]
        ],
        "excess": unknown.excess,
        "depends_on": None
        if curve is None
        else {
            "name": curve.name,
            "unit": curve.unit,
            "form": curve.form,
            "r2": curve.r2,
            "nats": curve.nats,
            "at": curve.centers.tolist(),
            "mean": curve.mean.tolist(),
            "low": curve.low.tolist(),
            "high": curve.high.tolist(),
        },
        "place": {
            "rows_px": unknown.rows_px,
            "columns_px": unknown.columns_px,
            "along_mm": unknown.along_mm,
            "aside_mm": unknown.aside_mm,
        },
        "frames": unknown.frames,
        "nearest": [
            {"id": effect.id, "left": 1.0 - effect.gap_closed, "left_sigma": effect.left_sigma}
            for effect in nearest
        ],
        "seam_mm": {
            "off_stated": unknown.seam_off_mm,
            "as_sheet": unknown.sheet_mm,
        },
    }


def _left_over(left_over: tuple[str, float] | None) -> dict[str, Any] | None:
    return None if left_over is None else {"covariate": left_over[0], "share": left_over[1]}


def plain(value: Any, digits: int = ALL_DIGITS) -> Any:
    """Return JSON's own types: lists for tuples, null for what is not finite, rounded numbers."""
    if isinstance(value, Mapping):
        return {key: plain(item, digits) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item, digits) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    return value
