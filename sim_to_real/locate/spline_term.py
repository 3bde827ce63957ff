"""The non-parametric term: how much of the gap a free function of one covariate, or of two, would close.

A function is piecewise linear between knots, so its coefficients are those of hats; it multiplies a source's
light or adds to the image. Functions are fitted to some frames and scored on others, each time together with
the nuisances: those of the fit that left the residuals were pulled by what it did not know of.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from noise_model.arrays import Bool, Float32, Float64, Int64
from sim_to_real.fit.gauss_newton import huber_bound, huber_weights
from sim_to_real.locate.covariates import UNITS, Covariates

KNOTS, KNOTS_OF_TWO = 9, (6, 7)
"""Knots of a function of one covariate, and of row and column."""

VALUES_PER_KNOT = 3
"""A covariate of few values gets a knot for so many of them: 24 frames' times are no smooth function."""

RIDGE = 1e-3
"""What is added to the information's diagonal, relative: a knot that hardly a bin sees stays at nought."""

FOLDS = 4
"""Into so many parts frames are put; each is predicted by the others."""

LEAST_EXCESS = 0.1
"""Of a smaller excess of mean r^2 over 1 no shares are told: what the model may be off is as large."""

EVERY = 4
"""One bin of so many is used: neighbours say much the same."""

LEVERAGE = 3.0
"""A bin that nuisances move by more than so many times the usual counts less: shadow edges are not linear."""

BOUND_ROUNDS = 3
"""How often nuisances beyond their bounds are put onto them before the rest is solved anew."""

SEED = 4
"""Of the choice of bins."""


Weight = Callable[[Covariates], Float32]

FORMS: tuple[tuple[str, Weight], ...] = (
    ("adds", lambda c: np.ones_like(c.sigma_dn)),
    ("times_arc", lambda c: c.arc_dn),
    ("times_laser", lambda c: c.laser_dn),
    ("times_light", lambda c: c.light_dn),
)
"""What a function may do: add DN, or multiply the arc's light, the laser's or both."""


@dataclass(frozen=True)
class FreeTerm:
    """A free function of `covariate`, how it acts (see `FORMS`), and which share of the gap it closes."""

    covariate: str
    form: str
    closed: float

    @property
    def name(self) -> str:
        """What a report calls it."""
        return f"{self.covariate} {self.form}"


def gap_size(covariates: Covariates, residuals: Float64, training: Bool) -> float:
    """Return sqrt(mean r^2 - 1) of the frames that are none of the training frames (n_frames,); 0 for no gap.

    What nuisances alone, fitted to the training frames' residuals, would take is taken off.
    """
    return _size(_held(covariates, residuals, training))


def free_term(
    covariates: Covariates, residuals: Float64, training: Bool, before: float
) -> tuple[FreeTerm, ...]:
    """Return the free functions of each covariate, and of row and column, best first.

    They are fitted to the residuals (n,) of the training frames (n_frames,) and scored on the others:
    `closed` is by how much they shrink the `gap_size` there, as a share of the size `before` anything was
    named. None are told of a gap that is hardly one.
    """
    if before**2 < LEAST_EXCESS:
        return ()
    fit = _held(covariates, residuals, training)
    chosen, left = fit.covariates, _size(fit)
    terms = []
    for name, basis in functions(chosen):
        for form, weight in FORMS:
            after = _size(fit, fit.gain(basis * _column(chosen, weight)))
            terms.append(FreeTerm(name, form, float(np.clip((left - after) / before, 0.0, 1.0))))
    return tuple(sorted(terms, key=lambda term: -term.closed))


def _held(covariates: Covariates, residuals: Float64, training: Bool) -> HeldOut:
    return HeldOut.of(covariates, residuals, np.where(training, 0, 1)[covariates.frame], scored=(1,))


def _size(fit: HeldOut, gained: float = 0.0) -> float:
    """Return sqrt(mean r^2 - 1) where nuisances alone, and so much besides, lower the mean square."""
    return math.sqrt(max(fit.mean_square - fit.alone - gained - 1.0, 0.0))


def functions(covariates: Covariates) -> Iterator[tuple[str, Float32]]:
    """Yield each covariate, and row and column together, with the hats of a function of it (n, k)."""
    for name in UNITS:
        yield name, hats(covariates.values[name])
    yield "row, column", hats_of_two(covariates)


def _column(covariates: Covariates, weight: Weight) -> Float32:
    return np.asarray((weight(covariates) / covariates.sigma_dn)[:, np.newaxis])


def hats(values: Float32, knots: int = KNOTS) -> Float32:
    """Return the hat functions (n, k) of values (n,): between two knots they fall from 1 to 0.

    Knots lie so that equally many values lie between two of them; fewer where there are few different values.
    A value that is NaN has no hat.
    """
    known = np.isfinite(values)
    distinct = np.unique(values[known])
    if len(distinct) > knots:
        knots = min(knots, max(2, len(distinct) // VALUES_PER_KNOT))
        places = np.unique(np.quantile(values[known], np.linspace(0.0, 1.0, knots)))
    else:
        places = distinct
    if len(places) < 2:
        return np.asarray(known, dtype=np.float32)[:, np.newaxis]
    X = np.zeros((len(values), len(places)), dtype=np.float32)
    left = np.clip(np.searchsorted(places, values[known], side="right") - 1, 0, len(places) - 2)
    share = np.clip((values[known] - places[left]) / np.diff(places)[left], 0.0, 1.0)
    rows = np.flatnonzero(known)
    X[rows, left], X[rows, left + 1] = 1.0 - share, share
    return X


def hats_of_two(covariates: Covariates, knots: tuple[int, int] = KNOTS_OF_TWO) -> Float32:
    """Return products of hats of row and column (n, k): piecewise bilinear functions over the image."""
    of_row, of_column = (
        hats(covariates.values[name], count) for name, count in zip(("row", "column"), knots, strict=True)
    )
    product = of_row[:, :, np.newaxis] * of_column[:, np.newaxis, :]
    return np.asarray(product.reshape(len(product), -1))


def folds_by_turn(covariates: Covariates) -> Int64:
    """Return which fold, 0 to `FOLDS` - 1, each bin (n,) is in: a frame's.

    Each frame goes where fewest of its stratum are, and of such folds where none has gone for longest: frames
    that cycle through the strata would by their number lie in one fold a stratum.
    """
    frames, first = np.unique(covariates.frame, return_index=True)
    counts, latest = Counter[tuple[int, int]](), [-1] * FOLDS
    fold_of = np.zeros(len(frames), dtype=np.int64)
    for n, stratum in enumerate(covariates.stratum[first].tolist()):
        fold = min(range(FOLDS), key=lambda k: (counts[k, stratum], latest[k], k))
        counts[fold, stratum] += 1
        latest[fold] = n
        fold_of[n] = fold
    return fold_of[np.searchsorted(frames, covariates.frame)]


def share(gained: float, mean_square: float) -> float:
    """Return which share, 0 to 1, of the excess of whitened residuals' mean square over 1 a gain in it is."""
    excess = max(mean_square - 1.0, LEAST_EXCESS)
    return float(np.clip(gained / excess, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Residuals of some bins, to be explained by designs on frames that these were not fitted to.

    `chosen` are those bins' places among all, `covariates` theirs, `residuals` (n,) and `weights` (n,)
    Huber's and those of leverage; `fold` (n,) are the parts, of which `scored` are predicted by the others.
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
        scored: tuple[int, ...] = tuple(range(FOLDS)),
        free: tuple[int, ...] = (),
    ) -> HeldOut:
        """Choose bins and weigh them; nuisances `free` are bound neither by priors nor by bounds."""
        draw = np.random.default_rng(SEED)
        chosen = np.flatnonzero(draw.random(len(residuals)) < 1.0 / EVERY)
        of_chosen = covariates.at(chosen)
        fold = folds_by_turn(of_chosen) if fold is None else fold[chosen]
        r = residuals[chosen]
        weights = huber_weights(r, huber_bound(r))
        sigmas = np.array([p.prior_sigma for p in covariates.nuisances])
        moved = np.sqrt(np.sum((of_chosen.tangents * sigmas) ** 2, axis=1))
        usual = LEVERAGE * max(1.0, float(np.median(moved))) if len(r) else 1.0
        weights = weights * np.minimum(1.0, usual / np.maximum(moved, usual))
        return cls(chosen, of_chosen, r, weights, fold, scored, free)

    @property
    def total_weight(self) -> float:
        """The sum of weights that are scored."""
        return float(np.sum(self.weights[np.isin(self.fold, self.scored)]))

    @property
    def mean_square(self) -> float:
        """The weighted mean of the scored residuals' squares; NaN without any."""
        at = np.isin(self.fold, self.scored)
        total = self.total_weight
        return float(self.weights[at] @ self.residuals[at] ** 2) / total if total > 0.0 else float("nan")

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
    def alone(self) -> float:
        """By how much nuisances alone lower the mean square; not < 0."""
        return max(0.0, self.gain_of(*self.moments(self.covariates.tangents)))

    def gain(self, X: Float32) -> float:
        """Return by how much a design (n, k) lowers the mean square beyond what nuisances alone do."""
        return self.gain_of(*self.moments(np.hstack([self.covariates.tangents, X]))) - self.alone

    def share(self, gained: float) -> float:
        """Return which share, 0 to 1, of the excess that nuisances leave over noise such a gain is."""
        return share(gained, self.mean_square - self.alone)

    def gain_of(self, A: Float64, b: Float64) -> float:
        """Return by how much a design lowers the mean square, of these moments, nuisances first."""
        all_A, all_b = A.sum(axis=0), b.sum(axis=0)
        gained = 0.0
        for k in self.scored:
            c = self.solved(all_A - A[k], all_b - b[k])
            gained += float(2.0 * c @ b[k] - c @ A[k] @ c)
        return gained / max(self.total_weight, 1e-9)

    def solved(self, A: Float64, b: Float64) -> Float64:
        """Return the coefficients (k,) of these moments, nuisances first and within their bounds."""
        nuisances, free = self.covariates.nuisances, np.array(self.free, dtype=np.int64)
        p, x = len(nuisances), self.covariates.anchor
        prior = np.array([1.0 / parameter.prior_sigma**2 for parameter in nuisances])
        lower = np.array([parameter.lower for parameter in nuisances]) - x
        upper = np.array([parameter.upper for parameter in nuisances]) - x
        prior[free], lower[free], upper[free] = 0.0, -np.inf, np.inf
        diagonal = np.diag(A)
        A = A + np.diag(np.concatenate([prior, RIDGE * diagonal[p:]]) + 1e-6 * diagonal + 1e-6)
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
