"""Location of the gap: along covariates, in patterns of the image, in strata; and what effects leave.

A free function of a covariate is a cubic spline, of normal coefficients a priori. It adds to the image, or
multiplies a source's light. Added to a linear hypothesis, its posterior has a closed form: the mean is a
curve, the covariance its band, and the evidence says how strongly the residual depends on the covariate.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline
from scipy.ndimage import distance_transform_edt
from scipy.special import logsumexp

from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from sim_to_real.data.binned import STRATA
from sim_to_real.diagnosis import Curve, Where
from sim_to_real.evidence.coordinates import ADDED_DN, hats_2d
from sim_to_real.evidence.error_model import ErrorModel, LinearHypothesis, SizeColumns
from sim_to_real.evidence.evidence_table import EvidenceTable, Sizes
from sim_to_real.evidence.policy import Policy
from sim_to_real.fit.covariates import UNITS, Covariates

MIN_EXCESS = 0.1
"""Shares are of an excess of this share of the floor at least: the model's own error is as large."""

FORMS: Mapping[str, Callable[[Covariates], Float32]] = {
    "adds": lambda bins: np.full_like(bins.sigma_dn, ADDED_DN),
    "times_arc": lambda bins: bins.arc_dn,
    "times_laser": lambda bins: bins.laser_dn,
    "times_light": lambda bins: bins.light_dn,
}
"""Action of a function: its change per unit (n,), DN."""

MIRRORED, OVER_IMAGE = "mirrored", "row, column"
"""The light at the place mirrored at the image's middle, as of a ghost; and any function over the image."""


@dataclass(frozen=True, eq=False)
class FunctionFamily:
    """All free functions of a covariate in a `form`, one of `FORMS`.

    `changes` (n, k) are the changes of bins, in sigmas, by a unit of each coefficient. The bins have
    `n_values` distinct values of the covariate. `at_places` (m, k) gives the function at `places` (m,) of it,
    less the part that errors of the light's levels explain.
    """

    form: str
    changes: Float32
    n_values: int
    places: Float64
    at_places: Float64


@dataclass(frozen=True, eq=False)
class FreeFunction:
    """The likeliest free function of some covariate, added to a hypothesis.

    `nats` is its evidence over the hypothesis `alone`, `sizes` holds its coefficients.
    """

    family: FunctionFamily
    nats: float
    sizes: Sizes
    alone: Sizes

    @classmethod
    def likeliest(
        cls, table: EvidenceTable, families: Sequence[FunctionFamily], policy: Policy
    ) -> "FreeFunction":
        """Return the likeliest of a covariate's functions, whose families are the blocks of a table."""
        alone = table.sizes()
        fitted = [
            (table.sizes(n, size=size), family)
            for n, family in enumerate(families)
            for size in policy.free_sizes
        ]
        sizes, family = max(fitted, key=lambda pair: pair[0].nats)
        # All forms and sizes are equally probable beforehand.
        nats = logsumexp([other.nats - alone.nats for other, _ in fitted]) - math.log(len(fitted))
        return cls(family, float(nats), sizes, alone)


@dataclass(frozen=True, eq=False)
class FreeFunctions:
    """The likeliest free function of each covariate, of row and column, and of the mirrored light.

    `before` are those added to no gap, `after` those added to what is named. A covariate that has a single
    value, or none, has no function.
    """

    before: Mapping[str, FreeFunction]
    after: Mapping[str, FreeFunction]

    @classmethod
    def of(
        cls,
        errors: ErrorModel,
        families: Mapping[str, Sequence[FunctionFamily]],
        none: LinearHypothesis,
        named: LinearHypothesis,
        policy: Policy,
    ) -> "FreeFunctions":
        """Return the functions added to `none`, no gap, and `named`, which is `none` if nothing is named."""
        hypotheses = [none] if named is none else [none, named]
        added: list[dict[str, FreeFunction]] = [{} for _ in hypotheses]
        for name, of_forms in families.items():
            blocks = errors.blocks([SizeColumns.free(family.changes) for family in of_forms])
            for functions, hypothesis in zip(added, hypotheses, strict=True):
                functions[name] = FreeFunction.likeliest(errors.table(hypothesis, blocks), of_forms, policy)
        return cls(added[0], added[-1])

    @cached_property
    def floor(self) -> float:
        """The mean square that is no gap: that of the stated errors, or less where anything leaves less."""
        every = [*self.before.values(), *self.after.values()]
        return min([1.0, *(sizes.mean_square for f in every for sizes in (f.sizes, f.alone))])

    def r2(self, name: str) -> float:
        """Return the share, 0 to 1, of the mean square's excess over the floor that a function explains.

        What a function leaves may differ from value to value, as frames' levels do along time. What it
        explains of that by chance is subtracted (Ezekiel 1930, Methods of Correlation Analysis).
        """
        if name not in self.before:
            return 0.0
        function = self.before[name]
        before, after = function.alone.mean_square, function.sizes.mean_square
        unexplained = 1.0 - (before - after) / max(before - self.floor, MIN_EXCESS * self.floor)
        n_values, n_coefficients = function.family.n_values, function.family.changes.shape[1]
        if n_values > n_coefficients:
            unexplained *= (n_values - 1) / (n_values - n_coefficients)
        return float(np.clip(1.0 - unexplained, 0.0, 1.0))

    def curve(self, name: str) -> Curve:
        """Return a covariate's function with its 95 % band, less the part that errors of levels explain.

        That part is its mean over bins, and its slope along the grey level. Without a function there are no
        places.
        """
        if name not in self.before:
            none = np.zeros(0)
            return Curve(name, UNITS[name], 0.0, "adds", 0.0, centers=none, mean=none, low=none, high=none)
        function = self.before[name]
        family, sizes = function.family, function.sizes
        per_unit = (ADDED_DN if family.form == "adds" else 1.0) * family.at_places
        # Columns change residuals: sizes cancel what the light has more than predicted.
        mean = -per_unit @ sizes.mean
        variance = np.maximum(np.sum(per_unit @ sizes.covariance * per_unit, axis=1), 0.0)
        # The 95 % band.
        half_band = 1.96 * np.sqrt(variance)
        return Curve(
            name=name,
            unit=UNITS[name],
            r2=self.r2(name),
            form=family.form,
            nats=function.nats,
            centers=family.places,
            mean=mean,
            low=mean - half_band,
            high=mean + half_band,
        )

    @property
    def left_over(self) -> tuple[str, float] | None:
        """The function that closes most of the gap beyond what is named, and the share of the gap.

        None if there is hardly a gap.
        """
        before = self.before[MIRRORED].alone.mean_square
        if before < (1.0 + MIN_EXCESS) * self.floor:
            return None
        name, best = min(self.after.items(), key=lambda item: item[1].sizes.mean_square)
        alone, added = (math.sqrt(sizes.mean_square - self.floor) for sizes in (best.alone, best.sizes))
        closed = (alone - added) / math.sqrt(before - self.floor)
        return f"{name} {best.family.form}", float(np.clip(closed, 0.0, 1.0))


def all_families(covariates: Covariates, compared: Int64) -> dict[str, list[FunctionFamily]]:
    """Return the functions of each covariate in all forms, in those bins (n,) of all that are compared."""
    bins = covariates.subset(compared)
    over_image = hats_2d(bins.values["row"], bins.values["column"], 6, 7) / bins.sigma_dn[:, np.newaxis]
    ghost = (_mirrored(covariates) / covariates.sigma_dn)[compared, np.newaxis]
    nowhere = len(ghost), np.zeros(0), np.zeros((0, 0))
    families = {name: covariate_families(name, bins) for name in UNITS}
    families[MIRRORED] = [FunctionFamily("adds", ghost, *nowhere)]
    families[OVER_IMAGE] = [
        FunctionFamily(form, over_image * light_dn(bins)[:, np.newaxis], *nowhere)
        for form, light_dn in FORMS.items()
    ]
    return {name: of_forms for name, of_forms in families.items() if of_forms}


def covariate_families(name: str, bins: Covariates) -> list[FunctionFamily]:
    """Return the functions of a covariate in each form that acts at two values of it or more."""
    families = []
    for form, light_dn in FORMS.items():
        per_bin = light_dn(bins) / bins.sigma_dn
        # Knots lie where the light is: elsewhere nothing would be known of the function.
        lit = np.isfinite(bins.values[name]) & (per_bin > 1.0)
        x, weights = bins.values[name][lit].astype(np.float64), per_bin[lit].astype(np.float64) ** 2
        if not (x != x[:1]).any():
            continue
        at_bins, places, at_places = _spline(x)
        # Levels change the light by the same share everywhere: along the grey level that is a slope.
        n_levels = 2 if (name, form) == ("gray_level", "adds") else 1
        levels = np.vander(x, n_levels)
        of_levels = np.linalg.solve(levels.T * weights @ levels, levels.T * weights @ at_bins)
        at_places = at_places - np.vander(places, n_levels) @ of_levels
        functions = np.zeros((len(lit), at_bins.shape[1]), dtype=np.float32)
        functions[lit] = at_bins
        n_values = len(np.unique(x))
        families.append(FunctionFamily(form, functions * per_bin[:, np.newaxis], n_values, places, at_places))
    return families


def _spline(x: Float64) -> tuple[Float64, Float64, Float64]:
    """Return functions (n, k) at values (n,), and places (m,) with the functions (m, k) there.

    They are cubic B-splines. Of few values each has a function of its own.
    """
    distinct = np.unique(x)
    # Each of up to 5 values has a coefficient of its own; of more, two share one.
    if len(distinct) <= 5:
        return np.equal.outer(x, distinct).astype(np.float64), distinct, np.eye(len(distinct))
    count = min(10, max(4, len(distinct) // 2))
    breaks, places = _spread(x, count - 2), _spread(x, 25)
    knots = np.concatenate([breaks[:1].repeat(3), breaks, breaks[-1:].repeat(3)])
    at_bins, at_places = (BSpline.design_matrix(values, knots, 3).toarray() for values in (x, places))
    return at_bins, places, at_places


def _spread(values: Float64, count: int) -> Float64:
    """Return `count` places over the range of values (n,), halfway between even ones and quantiles."""
    even, shares = np.linspace(values.min(), values.max(), count), np.linspace(0.0, 1.0, count)
    return np.asarray(0.5 * (even + np.quantile(values, shares)))


def _mirrored(covariates: Covariates) -> Float32:
    """Return the predicted light (n,), DN, at the place of each bin mirrored at the image's middle."""
    mirrored = np.empty_like(covariates.light_dn)
    for frame in np.unique(covariates.frame):
        of_frame = covariates.frame == frame
        image = covariates.image(int(frame), covariates.light_dn)
        # Where no bin counts, the nearest that does stands for the light.
        _, (rows, columns) = distance_transform_edt(np.isnan(image), return_indices=True)
        mirrored[of_frame] = image[rows, columns][::-1, ::-1].reshape(-1)[covariates.bins[of_frame]]
    return mirrored


def locate(
    functions: FreeFunctions,
    covariates: Covariates,
    residuals: Float64,
    stage: str,
    stages: Mapping[str, float],
    z: Float32,
) -> Where:
    """Return the location of whitened residuals (n,); `stage`, `stages` and `z` are those of `Where`."""
    curves = sorted(map(functions.curve, UNITS), key=lambda curve: -curve.r2)
    excess = residuals**2 - 1.0
    in_band = np.sum(excess[covariates.in_stripe]) / max(np.sum(excess), MIN_EXCESS * len(excess))
    patterns = dict(row="row", column="column", radial="radius", mirrored=MIRRORED, fixed=OVER_IMAGE)
    image = {name: functions.r2(key) for name, key in patterns.items()}
    image["stripe_band"] = float(np.clip(in_band, 0.0, 1.0))
    return Where(stage, stages, tuple(curves), image, strata_gaps(covariates, residuals), z)


def strata_gaps(covariates: Covariates, residuals: Float64) -> dict[str, float]:
    """Return sqrt(max(mean r^2 - 1, 0)) of each stratum's frames, of the stripe's band and of the rest.

    NaN for a stratum that the recording does not have.
    """
    chosen = {name: covariates.stratum == n for n, name in enumerate(STRATA)}
    chosen |= {"stripe_band": covariates.in_stripe, "rest": ~covariates.in_stripe}

    def gap(members: Bool) -> float:
        if not members.any():
            return math.nan
        return math.sqrt(max(float(np.mean(residuals[members] ** 2)) - 1.0, 0.0))

    return {name: gap(members) for name, members in chosen.items()}
