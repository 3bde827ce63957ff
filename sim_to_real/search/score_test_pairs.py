"""The score test of pairs of effects, from the signatures of single ones.

If two effects of similar size act together, the likeliest single effect is often a third one that mimics
both. No second effect beside this mimic then explains the gap, so pairs are scored on their own. The cost
along the probe points of all effects, and along the nuisances, is one quadratic. A pair of families takes a
few of its rows and columns, so all pairs are compared without predicting anything anew. Only the best of them
are solved within the bounds, which takes longer.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from noise_model.arrays import Float64
from sim_to_real.fit.gauss_newton import Refit
from sim_to_real.fit.quadratic import Quadratic
from sim_to_real.search.hypothesis import bic_penalty_nats, likelihood_nats
from sim_to_real.search.score_test import ScoreTest, with_columns

N_SOLVED_WITHIN_BOUNDS = 100
"""So many pairs of families are solved within their bounds."""


@dataclass(frozen=True, eq=False)
class PairScore:
    """The score of two effects together: their evidence, nats, and where a fit of both should start."""

    evidence: float
    starts: dict[str, dict[str, float]]


def score_pairs(baseline: Refit, scores: Sequence[ScoreTest], max_pairs: int) -> list[PairScore]:
    """Return at most `max_pairs` pairs of effects, the likeliest first, each with its best families.

    `scores` are the effects' own at the same baseline.
    """
    families = [family for score in scores for family in score.families]
    columns = np.hstack([family_score.signature for family_score in families])
    limits = [limit for family_score in families for limit in family_score.step_limits()]
    full = with_columns(baseline, baseline.residuals, columns, limits).summed()
    free = full.without_bounds(np.ones(len(full.x), dtype=np.bool_))
    n_fitted = len(baseline.x)
    ends = n_fitted + np.cumsum([len(family_score.steps) for family_score in families])

    def of_pair(quadratic: Quadratic, *pair: int) -> Quadratic:
        places = [np.arange(ends[n] - len(families[n].steps), ends[n]) for n in pair]
        return quadratic.restricted_to(np.concatenate([np.arange(n_fitted), *places]))

    def evidence(x: Float64, quadratic: Quadratic, *pair: int) -> float:
        n_parameters = sum(families[n].n_parameters for n in pair)
        return likelihood_nats(quadratic.mean_square(x)) - bic_penalty_nats(n_parameters)

    unbounded = []
    for pair in itertools.combinations(range(len(families)), 2):
        if families[pair[0]].id != families[pair[1]].id:
            quadratic = of_pair(free, *pair)
            unbounded.append((evidence(quadratic.solve(), quadratic, *pair), pair))
    best_of_pairs: dict[tuple[str, ...], PairScore] = {}
    for _, pair in sorted(unbounded, reverse=True)[:N_SOLVED_WITHIN_BOUNDS]:
        ids, quadratic = tuple(families[n].id for n in pair), of_pair(full, *pair)
        x = quadratic.solve()
        nats = evidence(x, quadratic, *pair)
        if ids not in best_of_pairs or nats > best_of_pairs[ids].evidence:
            t = np.split(x[n_fitted:], [len(families[pair[0]].steps)])
            starts = {
                families[n].id: families[n].parameters_along(along_pair)
                for n, along_pair in zip(pair, t, strict=True)
            }
            best_of_pairs[ids] = PairScore(nats, starts)
    return sorted(best_of_pairs.values(), key=lambda score: -score.evidence)[:max_pairs]
