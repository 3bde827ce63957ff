"""The first look at two effects at a time: what places of both would close, from what places of each do.

Of two effects of about one size the likeliest single one is often a third that mimics them together, and
what is looked for beside a mimic explains nothing. Along the places of all effects, and along the nuisances,
the cost is one quadratic, of which two families' places take a few rows and columns: so all pairs are
compared without predicting anything anew. Only the pairs that seem best without bounds are solved
within them, which takes longer.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from noise_model.arrays import Float64
from sim_to_real.fit.gauss_newton import Refit
from sim_to_real.fit.quadratic import Quadratic
from sim_to_real.search.hypothesis import cost_nats, likelihood_nats
from sim_to_real.search.score_test import Screened, with_columns

WITHIN_BOUNDS = 100
"""So many pairs of families are solved within bounds."""


@dataclass(frozen=True, eq=False)
class ScreenedPair:
    """Two effects after the first look: their evidence there, nats, and where a fit of both should start."""

    evidence: float
    starts: dict[str, dict[str, float]]


def screen_pairs(baseline: Refit, screened: Sequence[Screened], most: int) -> list[ScreenedPair]:
    """Return so many pairs of effects at most, those first that seem likeliest.

    Each is that of its best families. The effects were looked at from the baseline.
    """
    looks = [family for one in screened for family in one.families]
    columns = np.hstack([look.signature for look in looks])
    reaches = [reach for look in looks for reach in look.reaches()]
    every = with_columns(baseline, baseline.residuals, columns, reaches).summed()
    free = every.without_bounds(np.ones(len(every.x), dtype=np.bool_))
    n_fitted = len(baseline.x)
    ends = n_fitted + np.cumsum([len(look.steps) for look in looks])

    def of_pair(of: Quadratic, *pair: int) -> Quadratic:
        places = [np.arange(ends[n] - len(looks[n].steps), ends[n]) for n in pair]
        return of.only(np.concatenate([np.arange(n_fitted), *places]))

    def evidence(x: Float64, quadratic: Quadratic, *pair: int) -> float:
        n_parameters = sum(looks[n].n_parameters for n in pair)
        return likelihood_nats(quadratic.mean_square(x)) - cost_nats(n_parameters)

    anywhere = []
    for pair in itertools.combinations(range(len(looks)), 2):
        if looks[pair[0]].id != looks[pair[1]].id:
            quadratic = of_pair(free, *pair)
            anywhere.append((evidence(quadratic.solve(), quadratic, *pair), pair))
    found: dict[tuple[str, ...], ScreenedPair] = {}
    for _, pair in sorted(anywhere, reverse=True)[:WITHIN_BOUNDS]:
        ids, quadratic = tuple(looks[n].id for n in pair), of_pair(every, *pair)
        x = quadratic.solve()
        nats = evidence(x, quadratic, *pair)
        if ids not in found or nats > found[ids].evidence:
            t = np.split(x[n_fitted:], [len(looks[pair[0]].steps)])
            starts = {looks[n].id: looks[n].along(of) for n, of in zip(pair, t, strict=True)}
            found[ids] = ScreenedPair(nats, starts)
    return sorted(found.values(), key=lambda one: -one.evidence)[:most]
