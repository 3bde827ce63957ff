"""Several effects: forward and backward steps from the likeliest one, and each one's share of the gap."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from sim_to_real.fit.gauss_newton import MIN_EVIDENCE_NATS, Refit, converged, refit_from
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.search.hypothesis import (
    MAX_MISFIT_AT_FLOOR,
    MAX_PIXEL_FRACTION_KEPT,
    MIN_VISIBLE_MISFIT,
    UNRESOLVED_MEAN_SQUARE,
    Hypothesis,
    by_evidence,
    cross_validated,
    residual_fraction,
)
from sim_to_real.search.probe_points import is_negligible
from sim_to_real.search.score_test import ScoreTest, rescored
from sim_to_real.search.score_test_pairs import score_pairs
from sim_to_real.search.single_effects import (
    RESOLVED_MEAN_SQUARE,
    Search,
    fit_single_effects,
    score_catalogue,
    score_gain_nats,
    with_expensive,
    with_flicker,
)

MAX_RESIDUAL_FRACTION_JOINT = 0.12
"""Several effects explain a gap if they leave no more than this share of it."""

MIN_BESIDE_NATS = 10.0
"""Evidence of its own, nats, that an effect needs to be named beside others that explain most of the gap.

Where a single effect of the catalogue's form is there, the likeliest other one gains 4 nats at most.
"""

MIN_SCORE_NATS_BESIDE = 6.0
"""Evidence at the score test that an effect needs to be fitted beside one that explains the gap, nats."""

MIN_SHARE = 0.05
"""An effect with a smaller share of what is closed is named beside others only with `MIN_BESIDE_NATS`."""

MIN_FURTHER_CLOSED = 0.7
"""A further effect must close this share of what the others leave."""

MAX_JOINT_MEAN_SQUARE, MAX_JOINT_MEAN_SQUARE_IF_FITTED = 1.2, 1.5
"""Several effects must leave a mean square below the first: two or three can mimic most of another one's gap.

The second holds if they leave no more than the floor in the fitted frames, or nothing that pixels show.
"""

N_PAIRS = 3
"""So many pairs are fitted where the likeliest effect does not explain the gap."""

MAX_EFFECTS = 3
"""So many effects are named at most."""


def best_beside(
    search: Search,
    baseline: Hypothesis,
    best: Hypothesis,
    explained: bool,
    start: Refit,
    scores: Sequence[ScoreTest],
) -> Hypothesis | None:
    """Return a hypothesis of several effects that explains the gap better than the best one alone, or None.

    The misfit in pixels of a best effect that explains the gap is known. Where it leaves something, it may
    mimic two others: `scores` are those of all effects at `start`.
    """
    if best.is_bound_limited and residual_fraction(best, baseline) <= MAX_RESIDUAL_FRACTION_JOINT:
        # The best effect mimics another one: further effects would only give the mimic more parameters.
        return None
    if not explained or best.cv_mean_square > UNRESOLVED_MEAN_SQUARE:
        return stepwise(search, baseline, best, _pairs(search, start, scores))
    is_visible = best.pixel_misfit > MAX_MISFIT_AT_FLOOR
    if not is_visible and not _may_gain(search, best.refit, scores):
        return None
    joint = stepwise(search, baseline, best)
    if joint is None:
        return None
    if joint.bin_evidence - best.bin_evidence >= MIN_BESIDE_NATS and not is_negligible(
        _last_added(joint), search.model.stated_values
    ):
        return joint
    if not is_visible:
        return None
    # If further effects do not halve the misfit, pixels show the error of the effect's form.
    misfit_left = search.with_pixels(joint).pixel_misfit - 1.0
    return None if misfit_left > MAX_PIXEL_FRACTION_KEPT * (best.pixel_misfit - 1.0) else joint


def _may_gain(search: Search, fitted: Refit, scores: Sequence[ScoreTest]) -> bool:
    """Say whether a further effect gains enough by the score test to be fitted."""
    beside_fitted = with_flicker(search, fitted, rescored(fitted, scores))
    gains = (score_gain_nats(score, fitted) for score in beside_fitted)
    return max(gains, default=0.0) >= MIN_SCORE_NATS_BESIDE


def _pairs(search: Search, start: Refit, scores: Sequence[ScoreTest]) -> list[Hypothesis]:
    """Return fits of the pairs that are likeliest by the score test; the best one has converged."""
    model, pairs = search.model, []
    for pair in score_pairs(start, with_flicker(search, start, scores), N_PAIRS):
        search.on_stage(f"fitting {' and '.join(pair.starts)}", 0.0)
        pairs.append(cross_validated(model, refit_from(model, start, pair.starts)))
    pairs = by_evidence(pairs)
    if pairs and pairs[0].cv_mean_square > RESOLVED_MEAN_SQUARE:
        pairs[0] = cross_validated(model, converged(model, pairs[0].refit))
    return pairs


def stepwise(
    search: Search, baseline: Hypothesis, best: Hypothesis, pairs: Sequence[Hypothesis] = ()
) -> Hypothesis | None:
    """Return effects that explain the gap together, None if none do: forward steps, then backward ones.

    The first step is from the best effect to that and another one, or to one of the `pairs`.
    """
    chosen = best
    while chosen is best or (
        len(chosen.ids) < MAX_EFFECTS and residual_fraction(chosen, baseline) > MAX_RESIDUAL_FRACTION_JOINT
    ):
        search.on_stage("looking for further effects", 0.0)
        scores = score_catalogue(search, chosen.refit)
        if not scores:
            return None
        further = fit_single_effects(search, chosen.refit, scores, chosen.cv_mean_square)
        mean_square = further[0].cv_mean_square
        if mean_square > UNRESOLVED_MEAN_SQUARE or (
            mean_square > RESOLVED_MEAN_SQUARE
            and residual_fraction(further[0], baseline) > MAX_RESIDUAL_FRACTION_JOINT
        ):
            further = with_expensive(search, chosen.refit, further)
        if chosen is best:
            further = by_evidence([*further, *pairs])
        if further[0].evidence - chosen.bin_evidence < MIN_EVIDENCE_NATS:
            return None
        fraction = residual_fraction(further[0], baseline)
        if fraction > (1.0 - MIN_FURTHER_CLOSED) * residual_fraction(chosen, baseline):
            return None
        chosen = further[0]
    if chosen.cv_mean_square > MAX_JOINT_MEAN_SQUARE_IF_FITTED or chosen.is_bound_limited:
        return None
    if chosen.cv_mean_square > MAX_JOINT_MEAN_SQUARE and chosen.refit.mean_square > 1.0:
        chosen = search.with_pixels(chosen)
        if chosen.pixel_misfit > MIN_VISIBLE_MISFIT:
            return None
    for name in chosen.ids[:-1]:
        fewer = _without(search.model, chosen, name)
        if chosen.evidence - fewer.evidence < MIN_EVIDENCE_NATS:
            chosen = fewer
    return chosen


def _last_added(hypothesis: Hypothesis) -> dict[str, dict[str, float]]:
    """Return the effect that was added last."""
    name = hypothesis.ids[-1]
    return {name: hypothesis.refit.effects[name]}


def _without(model: LinearizedModel, hypothesis: Hypothesis, name: str) -> Hypothesis:
    """Return a hypothesis fitted again without one of its effects."""
    effects = {other: values for other, values in hypothesis.refit.effects.items() if other != name}
    return cross_validated(model, refit_from(model, hypothesis.refit, effects))


def with_shares(
    model: LinearizedModel, baseline: Hypothesis, chosen: Hypothesis
) -> tuple[Hypothesis, dict[str, float]]:
    """Return what is chosen without effects of a small share and little evidence, and the others' shares.

    An effect of a small share stays if its evidence is strong: a large one may be hidden by a larger one.
    """
    share_of = shares(model, baseline, chosen)

    def is_worth(name: str) -> bool:
        if share_of[name] >= MIN_SHARE:
            return True
        return chosen.evidence - _without(model, chosen, name).evidence >= MIN_BESIDE_NATS

    worth = {name: values for name, values in chosen.refit.effects.items() if is_worth(name)}
    if not worth or len(worth) == len(chosen.ids):
        return chosen, share_of
    rest = cross_validated(model, refit_from(model, chosen.refit, worth))
    return rest, shares(model, baseline, rest)


def shares(model: LinearizedModel, baseline: Hypothesis, chosen: Hypothesis) -> dict[str, float]:
    """Return each effect's share of the gap that all close together: Shapley's value (1953)."""
    names = chosen.ids
    if len(names) < 2:
        return dict.fromkeys(names, 1.0)
    mean_square: dict[frozenset[str], float] = {
        frozenset(): baseline.cv_mean_square,
        frozenset(names): chosen.cv_mean_square,
    }
    for number in range(1, len(names)):
        for some in itertools.combinations(names, number):
            effects = {name: chosen.refit.effects[name] for name in some}
            of_some = cross_validated(model, refit_from(model, chosen.refit, effects))
            # An effect that does harm without the others would be left neutral.
            of_fewer = (value for fewer, value in mean_square.items() if fewer < set(some))
            mean_square[frozenset(some)] = min(of_some.cv_mean_square, *of_fewer)
    # Below the model's floor the effects that leave least count as closing all.
    floor = 1.0 if baseline.cv_mean_square > 1.0 else min(mean_square.values())
    gap_size = {ids: math.sqrt(max(value - floor, 0.0)) for ids, value in mean_square.items()}
    total = gap_size[frozenset()] - gap_size[frozenset(names)]
    if total <= 0.0:
        return dict.fromkeys(names, 1.0 / len(names))
    value = dict.fromkeys(names, 0.0)
    for order in itertools.permutations(names):
        for n, name in enumerate(order):
            value[name] += gap_size[frozenset(order[:n])] - gap_size[frozenset(order[: n + 1])]
    n_orders = math.factorial(len(names))
    return {name: float(np.clip(sums / n_orders / total, 0.0, 1.0)) for name, sums in value.items()}
