"""The spline term: how much of the gap a free function of one covariate, or of two, would close.

A function is piecewise linear between knots: a sum of hat functions. It multiplies a source's light or adds
to the image. Functions are fitted to some frames and scored on others. Nuisances may be fitted with them,
since the gap has biased those of the fit that left the residuals.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from noise_model.arrays import Bool, Float32, Float64, Int64
from sim_to_real.fit.loss import huber_bound, huber_weights
from sim_to_real.locate.covariates import UNITS, Covariates

N_KNOTS, N_KNOTS_2D = 9, (6, 7)
"""Knots of a function of one covariate, and of row and column."""

VALUES_PER_KNOT = 3
"""A covariate with few distinct values gets one knot for so many of them, so that it stays smooth."""

KNOT_RIDGE_REL = 1e-3
"""Relative ridge on the information's diagonal: a knot that hardly any bin sees stays at 0."""

DIAGONAL_REL, DIAGONAL = 1e-6, 1e-6
"""What is added to the diagonal besides, relative and absolute, so that it can be inverted."""

SPLINE_FOLDS = 4
"""Folds of frames; each is predicted from the others."""

MIN_EXCESS = 0.1
"""Shares are of this excess of mean r^2 over 1 at least: the model's own error is as large."""

SUBSAMPLE = 4
"""One bin in so many is used: neighbours carry much the same information."""

MAX_LEVERAGE_RATIO = 3.0
"""A bin that nuisances change by more than so many times the median counts less: edges are not linear."""

BOUND_ROUNDS = 3
"""Rounds of setting nuisances to the bounds that they pass and solving for the others."""

SUBSAMPLE_SEED = 4
"""The seed of the choice of bins."""


Weight = Callable[[Covariates], Float32]

SPLINE_FORMS: tuple[tuple[str, Weight], ...] = (
    ("adds", lambda c: np.ones_like(c.sigma_dn)),
    ("times_arc", lambda c: c.arc_dn),
    ("times_laser", lambda c: c.laser_dn),
    ("times_light", lambda c: c.light_dn),
)
"""How a function acts: it adds DN, or multiplies the arc's light, the laser's or both."""


@dataclass(frozen=True)
class SplineTerm:
    """A free function of `covariate`, its form (see `SPLINE_FORMS`), and the share of the gap it closes."""

    covariate: str
    form: str
    closed: float

    @property
    def name(self) -> str:
        """Its name in a report."""
        return f"{self.covariate} {self.form}"


def gap_size(covariates: Covariates, residuals: Float64, training: Bool) -> float:
    """Return sqrt(mean r^2 - 1) of the frames that are no training frames (n_frames,); 0 for no gap.

    What nuisances alone, fitted to the training frames, would close is subtracted.
    """
    return _size(_trained_on(covariates, residuals, training))


def spline_terms(
    covariates: Covariates, residuals: Float64, training: Bool, before: float
) -> tuple[SplineTerm, ...]:
    """Return the free functions of each covariate, and of row and column, best first.

    They are fitted to the residuals (n,) of the training frames (n_frames,) and scored on the others:
    `closed` is by how much they shrink the `gap_size` there, over the size `before` any effect was fitted.
    There are none if the gap is negligible.
    """
    if before**2 < MIN_EXCESS:
        return ()
    fit = _trained_on(covariates, residuals, training)
    chosen, size_left = fit.covariates, _size(fit)
    terms = []
    for name, basis in basis_functions(chosen):
        for form, weight in SPLINE_FORMS:
            after = _size(fit, fit.gain(basis * _column(chosen, weight)))
            terms.append(SplineTerm(name, form, float(np.clip((size_left - after) / before, 0.0, 1.0))))
    return tuple(sorted(terms, key=lambda term: -term.closed))


def _trained_on(covariates: Covariates, residuals: Float64, training: Bool) -> CrossValidation:
    return CrossValidation.of(covariates, residuals, np.where(training, 0, 1)[covariates.frame], scored=(1,))


def _size(fit: CrossValidation, gained: float = 0.0) -> float:
    """Return sqrt(mean r^2 - 1) after the gain of nuisances alone and a further gain."""
    return math.sqrt(max(fit.mean_square - fit.nuisance_gain - gained - 1.0, 0.0))


def basis_functions(covariates: Covariates) -> Iterator[tuple[str, Float32]]:
    """Yield each covariate, and row and column together, with the hat functions (n, k) of it."""
    for name in UNITS:
        yield name, hat_basis(covariates.values[name])
    yield "row, column", hat_basis_2d(covariates)


def _column(covariates: Covariates, weight: Weight) -> Float32:
    return np.asarray((weight(covariates) / covariates.sigma_dn)[:, np.newaxis])


def hat_basis(values: Float32, knots: int = N_KNOTS) -> Float32:
    """Return the hat functions (n, k) of values (n,): each falls from 1 at its knot to 0 at the next ones.

    Knots lie at quantiles of the values; there are fewer for few distinct values. NaN belongs to no hat.
    """
    known = np.isfinite(values)
    distinct = np.unique(values[known])
    if len(distinct) > knots:
        knots = min(knots, max(2, len(distinct) // VALUES_PER_KNOT))
        places = np.unique(np.quantile(values[known], np.linspace(0.0, 1.0, knots)))
    else:
        places = distinct
    return hats_at(places, values)


def hats_at(places: Float32 | Float64, values: Float32) -> Float32:
    """Return the hat functions (n, k) of values (n,), knots at rising places (k,); one for fewer than two.

    NaN belongs to no hat.
    """
    known = np.isfinite(values)
    if len(places) < 2:
        return np.asarray(known, dtype=np.float32)[:, np.newaxis]
    X = np.zeros((len(values), len(places)), dtype=np.float32)
    lower = np.clip(np.searchsorted(places, values[known], side="right") - 1, 0, len(places) - 2)
    share = np.clip((values[known] - places[lower]) / np.diff(places)[lower], 0.0, 1.0)
    rows = np.flatnonzero(known)
    X[rows, lower], X[rows, lower + 1] = 1.0 - share, share
    return X


def hat_basis_2d(covariates: Covariates, knots: tuple[int, int] = N_KNOTS_2D) -> Float32:
    """Return products of hats of row and column (n, k): piecewise bilinear functions over the image."""
    of_row, of_column = (
        hat_basis(covariates.values[name], count)
        for name, count in zip(("row", "column"), knots, strict=True)
    )
    return pairwise_products(of_row, of_column)


def pairwise_products(first: Float32, second: Float32) -> Float32:
    """Return the products (n, k j) of each of some functions (n, k) with each of others (n, j)."""
    product = first[:, :, np.newaxis] * second[:, np.newaxis, :]
    return np.asarray(product.reshape(len(product), -1))


def folds_by_turn(covariates: Covariates) -> Int64:
    """Return the fold, 0 to `SPLINE_FOLDS` - 1, of each bin (n,): that of its frame.

    A frame goes into the fold with the fewest frames of its stratum; of several such folds, into the one that
    has waited longest. Dealing frames out by their number could put all of a stratum into one fold.
    """
    frames, first = np.unique(covariates.frame, return_index=True)
    counts, latest = Counter[tuple[int, int]](), [-1] * SPLINE_FOLDS
    fold_of = np.zeros(len(frames), dtype=np.int64)
    for n, stratum in enumerate(covariates.stratum[first].tolist()):
        fold = min(range(SPLINE_FOLDS), key=lambda k: (counts[k, stratum], latest[k], k))
        counts[fold, stratum] += 1
        latest[fold] = n
        fold_of[n] = fold
    return fold_of[np.searchsorted(frames, covariates.frame)]


def excess_share(gained: float, mean_square: float) -> float:
    """Return a gain as a share, 0 to 1, of the excess of whitened residuals' mean square over 1."""
    excess = max(mean_square - 1.0, MIN_EXCESS)
    return float(np.clip(gained / excess, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Residuals of some bins, to be explained by designs on frames that the designs were not fitted to.

    `chosen` are the bins' places among all. `covariates`, `residuals` (n,), `weights` (n,), which are Huber's
    and those of leverage, and `fold` (n,) are theirs. The folds in `scored` are predicted from the others.
    Nuisances in `free` are limited neither by priors nor by bounds.
    """

    chosen: Int64
    covariates: Covariates
    residuals: Float64
    weights: Float64
    fold: Int64
    scored: tuple[int, ...]
    free: tuple[int, ...] = ()

    @classmethod
    def of(
        cls,
        covariates: Covariates,
        residuals: Float64,
        fold: Int64 | None = None,
        scored: tuple[int, ...] = tuple(range(SPLINE_FOLDS)),
        free: tuple[int, ...] = (),
    ) -> CrossValidation:
        """Choose bins and weigh them."""
        draw = np.random.default_rng(SUBSAMPLE_SEED)
        chosen = np.flatnonzero(draw.random(len(residuals)) < 1.0 / SUBSAMPLE)
        of_chosen = covariates.subset(chosen)
        fold = folds_by_turn(of_chosen) if fold is None else fold[chosen]
        r = residuals[chosen]
        weights = huber_weights(r, huber_bound(r))
        sigmas = np.array([p.prior_sigma for p in covariates.nuisances])
        moved = np.sqrt(np.sum((of_chosen.tangents * sigmas) ** 2, axis=1))
        usual = MAX_LEVERAGE_RATIO * max(1.0, float(np.median(moved))) if len(r) else 1.0
        weights = weights * np.minimum(1.0, usual / np.maximum(moved, usual))
        return cls(chosen, of_chosen, r, weights, fold, scored, free)

    @property
    def total_weight(self) -> float:
        """The sum of the scored bins' weights."""
        return float(np.sum(self.weights[np.isin(self.fold, self.scored)]))

    @property
    def mean_square(self) -> float:
        """The weighted mean of the scored residuals' squares; NaN without any."""
        is_scored = np.isin(self.fold, self.scored)
        total = self.total_weight
        if total <= 0.0:
            return float("nan")
        return float(self.weights[is_scored] @ self.residuals[is_scored] ** 2) / total

    def moments(self, X: Float32) -> tuple[Float64, Float64]:
        """Return X^T w X (folds, k, k) and X^T w r (folds, k) of each fold's rows of a design (n, k)."""
        n_folds = max(int(self.fold.max(initial=0)), *self.scored) + 1
        root = np.sqrt(self.weights).astype(np.float32)
        A, b = np.zeros((n_folds, X.shape[1], X.shape[1])), np.zeros((n_folds, X.shape[1]))
        for k in range(n_folds):
            of_fold = self.fold == k
            rows = X[of_fold] * root[of_fold, np.newaxis]
            A[k] = rows.T @ rows
            b[k] = rows.T @ (root[of_fold] * self.residuals[of_fold].astype(np.float32))
        return A, b

    @cached_property
    def nuisance_gain(self) -> float:
        """By how much nuisances alone lower the mean square: all, those in `free`, or none of them."""
        return max(0.0, self.best_gain(*self.moments(self.covariates.tangents)))

    def gain(self, X: Float32) -> float:
        """Return by how much a design (n, k) lowers the mean square beyond what nuisances alone do.

        Nuisances are fitted with the design, or those that are not in `free` stay as they are, whichever
        predicts the scored frames better.
        A frame's own piece of seam is not seen by others, so fitting can do more harm than the design does
        good.
        """
        return self.best_gain(*self.moments(np.hstack([self.covariates.tangents, X]))) - self.nuisance_gain

    def best_gain(self, A: Float64, b: Float64) -> float:
        """Return the larger gain of these moments, nuisances first: with all fitted, or those in `free`."""
        used = np.array([*self.free, *range(len(self.covariates.nuisances), A.shape[1])], dtype=np.int64)
        kept = self._scored_gain(A[:, used[:, np.newaxis], used], b[:, used], _ridge_solution)
        return max(self.gain_from_moments(A, b), kept)

    def excess_share(self, gained: float) -> float:
        """Return a gain as a share, 0 to 1, of the excess over noise that nuisances alone leave."""
        return excess_share(gained, self.mean_square - self.nuisance_gain)

    def gain_from_moments(self, A: Float64, b: Float64) -> float:
        """Return by how much a design with these moments lowers the mean square; nuisances come first."""
        return self._scored_gain(A, b, self.coefficients)

    def _scored_gain(self, A: Float64, b: Float64, solve: Callable[[Float64, Float64], Float64]) -> float:
        all_A, all_b = A.sum(axis=0), b.sum(axis=0)
        gained = 0.0
        for k in self.scored:
            c = solve(all_A - A[k], all_b - b[k])
            gained += float(2.0 * c @ b[k] - c @ A[k] @ c)
        return gained / max(self.total_weight, 1e-9)

    def coefficients(self, A: Float64, b: Float64) -> Float64:
        """Return the coefficients (k,) of a design with these moments, nuisances first, within bounds."""
        nuisances, free = self.covariates.nuisances, np.array(self.free, dtype=np.int64)
        p, x = len(nuisances), self.covariates.anchor
        prior = np.array([1.0 / parameter.prior_sigma**2 for parameter in nuisances])
        lower = np.array([parameter.lower for parameter in nuisances]) - x
        upper = np.array([parameter.upper for parameter in nuisances]) - x
        prior[free], lower[free], upper[free] = 0.0, -np.inf, np.inf
        diagonal = np.diag(A)
        A = A + np.diag(
            np.concatenate([prior, KNOT_RIDGE_REL * diagonal[p:]]) + DIAGONAL_REL * diagonal + DIAGONAL
        )
        b = b - np.concatenate([prior * x, np.zeros(len(b) - p)])
        c, fixed = np.zeros(len(b)), np.zeros(len(b), dtype=bool)
        for _ in range(BOUND_ROUNDS):
            rest = ~fixed
            c[rest] = np.linalg.solve(A[np.ix_(rest, rest)], b[rest] - A[np.ix_(rest, fixed)] @ c[fixed])
            inside = np.clip(c[:p], lower, upper)
            fixed[:p] |= inside != c[:p]
            if (inside == c[:p]).all():
                break
            c[:p] = inside
        return c


def _ridge_solution(A: Float64, b: Float64) -> Float64:
    """Return the coefficients (k,) of a design with these moments, limited by no prior and no bound."""
    diagonal = np.diag(A)
    return np.asarray(np.linalg.solve(A + np.diag((KNOT_RIDGE_REL + DIAGONAL_REL) * diagonal + DIAGONAL), b))
