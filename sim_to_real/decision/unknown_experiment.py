"""Choice of the experiment that tells most about an unknown cause: by what its free terms predict of it.

The likeliest terms of different kinds, as the place in the image and that on the part, are fitted to what was
recorded. Each predicts the frames of each experiment with its posterior, and the experiment is chosen where
these differ most, as in `next_experiment`.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from noise_model.compiled.arrays import Int64
from noise_model.effects.effect import Stage
from sim_to_real.data.binned import ObservedRecording
from sim_to_real.decision.experiments import MENU, MORE_OF_UNKNOWN, Experiment
from sim_to_real.decision.next_experiment import (
    PlannedForecast,
    expected_certainty,
    is_frame_level,
    is_recorded,
    nats_apart,
    planned_model,
)
from sim_to_real.decision.unknown_terms import rival_terms
from sim_to_real.diagnosis import Next, UnknownTerm
from sim_to_real.evidence.coordinates import free_terms
from sim_to_real.evidence.error_model import ErrorModel, LinearHypothesis
from sim_to_real.evidence.metric import rescale_errors
from sim_to_real.evidence.policy import Policy
from sim_to_real.fit.covariates import Covariates, covariates
from sim_to_real.fit.gauss_newton import Refit, refit
from sim_to_real.fit.linearized_model import LinearizedModel

N_BINS = 600
"""Bins of each experiment's frame: neighbours are nearly redundant."""

AGAIN = "again"
"""The key of the experiment that takes the same frames later."""

CHANGES: Mapping[str, tuple[str, ...]] = {
    "image": ("shifted", "turned", "raised"),
    "part": ("shifted", "turned", "raised"),
    "pose": ("shifted", "turned", "raised"),
    "time": (AGAIN, "faster"),
    "angle": ("sideways", "along"),
    "grey level": ("exposure",),
    "hall": ("dark", "exposure"),
    "distance": ("raised", "current"),
    "sheet": ("raised", "sideways"),
}
"""Experiments that change what a term of each kind of coordinate depends on, the best first, by key."""

TELLS: Mapping[str, str] = {
    "dark": "with laser and arc off, only the scene's own light and the sensor's offset stay",
    "laser": "with the arc off, only what belongs to the laser, the hall and the sensor stays",
    "arc": "with the laser off, what belongs to the stripe goes",
    "exposure": "half the exposure halves all light, an offset stays, and a response meets other grey levels",
    "current": "another current changes the arc's light alone",
    "raised": "at another height the part moves through the image; what is fixed to the camera stays",
    "sideways": "a tilt changes the angles at the metal; what is fixed to the camera stays",
    "along": "a tilt changes the angles at the metal; what is fixed to the camera stays",
    "faster": "what goes with time stays in time, what goes with the part comes sooner",
    "shifted": "what is fixed to the part moves in the image, what is fixed to the camera stays",
    "turned": "what is fixed to the part turns in the image, what is fixed to the camera stays",
    AGAIN: "what comes again is fixed to part or camera, what does not goes with time",
}
"""Information that each experiment gives, by its key."""


def unknown_experiment(
    model: LinearizedModel,
    of_bins: Covariates,
    fitted: Refit,
    errors: ErrorModel,
    terms: tuple[UnknownTerm, ...],
    policy: Policy,
) -> Next:
    """Return the experiment with the largest expected certainty about the likeliest terms.

    `of_bins` are the covariates of the bins that were compared, `fitted` the fit that the terms are added to.
    The terms count as equally probable: none of them need be the whole cause. Of experiments that tell them
    apart, one that changes what the likeliest term depends on is preferred. Where none tells them apart the
    best one is proposed all the same.
    """
    menu = _menu(model.observed)
    rivals = rival_terms(terms)
    certainty, nearest = np.full(len(menu), 1.0 / len(rivals)), np.zeros(len(menu))
    if len(rivals) > 1:
        planned = planned_model(model, menu)
        planned = planned.with_bins(_some_bins(planned.observed))
        forecasts = _forecasts(planned, menu, of_bins, fitted, errors, rivals)
        weights = np.full(len(rivals), 1.0 / len(rivals))
        apart = nats_apart(planned, forecasts)
        certainty = expected_certainty(apart, weights, policy.temperature)
        nearest = np.min(apart[~np.eye(len(rivals), dtype=np.bool_)], axis=0)
    known = [experiment.key != AGAIN and is_recorded(experiment, model.observed) for experiment in menu]
    # Terms that fit differently already are told apart by most: what the likeliest depends on is changed.
    wanted = CHANGES[rivals[0].coordinate][::-1]
    change = np.array([wanted.index(e.key) + 1.0 if e.key in wanted else 0.0 for e in menu])
    rank = np.where(known, -1.0, np.where(certainty >= policy.named, 1.0 + change, certainty))
    best = int(np.lexsort([nearest, rank])[-1])
    return Next(
        experiment=menu[best].name,
        separates=tuple(term.words for term in rivals),
        resolves=bool(certainty[best] >= policy.named),
        reason=TELLS[menu[best].key],
        certainty=float(certainty[best]),
    )


def _menu(observed: ObservedRecording) -> list[Experiment]:
    """Return the experiments that can be done: where no frame shows the arc, none has it."""
    has_arc = bool(observed.lit.any())
    menu: list[Experiment] = []
    for experiment in (*MENU, *MORE_OF_UNKNOWN):
        possible = experiment if has_arc else replace(experiment, arc_on=False, current=1.0)
        if all(replace(possible, key=e.key, name=e.name) != e for e in menu) or possible.key == AGAIN:
            menu.append(possible)
    return menu


def _some_bins(observed: ObservedRecording) -> Int64:
    """Return the places (n,) of some bins of each frame, among those of all frames."""
    draw, starts = np.random.default_rng(0), np.cumsum(observed.counts) - observed.counts
    return np.concatenate(
        [
            start + np.sort(draw.permutation(count)[:N_BINS])
            for start, count in zip(starts, observed.counts, strict=True)
        ]
    )


def _forecasts(
    planned: LinearizedModel,
    menu: Sequence[Experiment],
    of_bins: Covariates,
    fitted: Refit,
    errors: ErrorModel,
    rivals: Sequence[UnknownTerm],
) -> list[PlannedForecast]:
    """Return what each term predicts of each planned frame, with the uncertainty of all that was fitted."""
    planned = planned.anchored_at(fitted.nuisance, fitted.effects, fitted.trend)
    ahead = refit(planned, fitted.effects, fitted.nuisance, 0, fitted.trend)
    free = free_terms(_joined(of_bins, _later(covariates(planned, ahead), menu, of_bins)))
    linear, n = LinearHypothesis.of(fitted), len(of_bins.frame)
    start = (fitted.x - fitted.quadratic.prior_starts) / fitted.quadratic.prior_sigmas
    shared, ahead_shared = ~is_frame_level(fitted), ~is_frame_level(ahead)
    changes = (ahead.jacobian * ahead.quadratic.prior_sigmas)[:, ahead_shared]
    ends = np.cumsum([0, *planned.observed.counts])
    mean_dn = np.concatenate([light.mean_dn() for light in ahead.lights])
    forecasts = []
    for term in rivals:
        columns = term.size * free.columns_of(Stage(term.stage), term.name).astype(np.float64)
        seen = np.column_stack([linear.columns.changes, columns[:n], linear.residuals])
        products = errors.metric.products(seen, seen)
        sides = np.concatenate([linear.columns.sides, np.zeros(columns.shape[1])])
        _, variance, _ = rescale_errors(products, sides, n)
        information = products[:-1, :-1] / variance + np.eye(len(products) - 1)
        sizes = -np.linalg.solve(information, products[:-1, -1] / variance)
        root = np.linalg.cholesky(np.linalg.inv(information))
        kept = np.concatenate([shared, np.ones(columns.shape[1], dtype=np.bool_)])
        moved = np.concatenate([(sizes[: len(start)] - start)[shared], sizes[len(start) :]])
        # Columns change residuals: a prediction changes the other way.
        ahead_columns = np.hstack([changes, columns[n:]])
        mean, spread = mean_dn - ahead_columns @ moved, ahead_columns @ root[kept]
        parts = list(itertools.pairwise(ends))
        forecasts.append(
            PlannedForecast(tuple(mean[a:b] for a, b in parts), tuple(spread[a:b] for a, b in parts))
        )
    return forecasts


def _later(planned: Covariates, menu: Sequence[Experiment], of_bins: Covariates) -> Covariates:
    """Return planned bins at their time, s: at the end of the recording, or as long again after it."""
    end_s = float(np.max(of_bins.values["time"], initial=0.0))
    times_s = np.array([2.0 * end_s if experiment.key == AGAIN else end_s for experiment in menu])
    time = times_s[planned.frame].astype(np.float32)
    frame = planned.frame + 1 + np.max(of_bins.frame, initial=0)
    return replace(planned, values={**planned.values, "time": time}, frame=frame)


def _joined(first: Covariates, second: Covariates) -> Covariates:
    """Return the bins of both: their functions have the same knots then."""
    values = {name: np.concatenate([first.values[name], second.values[name]]) for name in first.values}
    arrays = vars(first).keys() - {"shape", "values"}
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in arrays
    }
    return replace(first, values=values, **joined)
