"""Description of an unknown cause: what it may be, where and when it acts, what it does to the seam."""

import math

import numpy as np

from noise_model.compiled.arrays import Float32, Float64
from sim_to_real.decision.unknown_terms import likely_terms
from sim_to_real.diagnosis import Curve, UnknownDescription
from sim_to_real.evidence.error_model import ErrorModel, LinearHypothesis
from sim_to_real.evidence.free_functions import FreeFunctions
from sim_to_real.evidence.policy import Policy
from sim_to_real.fit.covariates import UNITS, Covariates
from sim_to_real.fit.gauss_newton import Refit
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.nuisances import N_LEVELS, apply_nuisances
from tracker.geometry import to_laser_plane

NOWHERE = math.nan, math.nan


def describe_unknown(
    model: LinearizedModel,
    of_bins: Covariates,
    fitted: Refit,
    functions: FreeFunctions,
    errors: ErrorModel,
    policy: Policy,
) -> UnknownDescription:
    """Describe what a fit leaves in the bins that were compared, whose covariates are `of_bins`.

    `functions` are the free functions before and after what is named: those after describe what is left.
    """
    excess = np.maximum(fitted.residuals**2 - 1.0, 0.0)
    rows, columns = of_bins.values["row"], of_bins.values["column"]
    along, aside = of_bins.part_mm.T
    spans = [_middle_half(values, excess) for values in (rows, columns, along, aside)]
    lateral_mm, vertical_mm, sheet_mm = _seam(model, fitted)
    return UnknownDescription(
        terms=likely_terms(LinearHypothesis.of(fitted), errors, policy),
        curve=unexplained_curve(functions),
        rows_px=spans[0],
        columns_px=spans[1],
        along_mm=spans[2],
        aside_mm=spans[3],
        spread=_share_of(rows, spans[0]) * _share_of(columns, spans[1]),
        frames=_frames_of_half(model, of_bins, excess),
        n_frames=len(model.observed.frames),
        excess=math.sqrt(max(float(np.mean(fitted.residuals**2)) - 1.0, 0.0)),
        seam_off_mm=(lateral_mm, vertical_mm),
        sheet_mm=sheet_mm,
    )


def unexplained_curve(functions: FreeFunctions) -> Curve | None:
    """Return the function of one covariate that explains most of what is left, None without any."""
    after = FreeFunctions(functions.after, functions.after)
    curve = max(map(after.curve, UNITS), key=lambda curve: curve.r2)
    return curve if len(curve.centers) else None


def _middle_half(values: Float32, weights: Float64) -> tuple[float, float]:
    """Return the quartiles of values (n,) by weight, NaN where none is known."""
    known = np.isfinite(values)
    order = np.argsort(values[known], kind="stable")
    total = np.cumsum(weights[known][order])
    if not len(total) or total[-1] <= 0.0:
        return NOWHERE
    low, high = np.searchsorted(total / total[-1], (0.25, 0.75))
    ordered = values[known][order]
    return float(ordered[low]), float(ordered[min(high, len(ordered) - 1)])


def _share_of(values: Float32, span: tuple[float, float]) -> float:
    """Return the share of values (n,) that lie within a span, NaN where the span is not known."""
    if not math.isfinite(span[0]):
        return math.nan
    return float(np.mean((values >= span[0]) & (values <= span[1])))


def _frames_of_half(model: LinearizedModel, of_bins: Covariates, excess: Float64) -> tuple[int, ...]:
    """Return the indices of the fewest frames that hold half of the excess (n,), in order."""
    of_frame = np.bincount(of_bins.frame, excess, minlength=len(model.observed.frames))
    order = np.argsort(-of_frame, kind="stable")
    count = int(np.searchsorted(np.cumsum(of_frame[order]), 0.5 * of_frame.sum())) + 1
    return tuple(sorted(model.observed.frames[n].index for n in order[:count]))


def _seam(model: LinearizedModel, fitted: Refit) -> tuple[float, float, float]:
    """Return how far the fitted seam lies off its stated line, lateral and vertical, mm, where it was seen.

    The last is the displacement of the laser's sheet, along its normal, that would move the stripe as the
    height does. NaN where the tracker found no seam.
    """
    observed = model.observed
    sightings = observed.seam_observations
    if not len(sightings.image_px):
        return math.nan, math.nan, math.nan
    true = apply_nuisances(observed.setup, fitted.nuisance)
    seam = model.renderings.seam_curve(fitted.effects)
    y_z, _ = seam.evaluate(fitted.nuisance[N_LEVELS:])
    stations_mm, _ = sightings.in_joint(true)
    lateral_mm, vertical_mm = (
        float(np.mean(np.interp(stations_mm, seam.stations_mm, of_axis))) for of_axis in y_z
    )
    # A sheet that is off along its normal moves what is seen along its ray.
    _, rays = to_laser_plane(true, sightings.image_px)
    per_height = float(np.nanmean(rays @ true.laser.plane[:3] / rays[:, 2]))
    return lateral_mm, vertical_mm, vertical_mm * per_height
