"""Hypotheses that verdicts are about, and frames, without the fits behind them."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from noise_model.effects import REGISTRY
from sim_to_real.search.hypothesis import likelihood_nats


@dataclass
class Fitted:
    """The part of a `Hypothesis` that a verdict asks for."""

    ids: tuple[str, ...]
    cv_mean_square: float
    refit: SimpleNamespace
    evidence: float
    bin_evidence: float
    pixel_misfit: float = np.nan
    is_bound_limited: bool = False


def hypothesis(*ids, mean_square=1.0):
    effects = {name: REGISTRY[name].complete(REGISTRY[name].typical) for name in ids}
    residuals = np.full(4, np.sqrt(mean_square))
    fit = SimpleNamespace(
        ids=ids, residuals=residuals, nuisance=None, effects=effects, trend=None, mean_square=mean_square
    )
    return Fitted(ids, mean_square, fit, likelihood_nats(mean_square), likelihood_nats(mean_square))


def seen(kinds, bins=None):
    """Frames of these kinds, of which so many bins count in each; 9 if nothing is said."""
    values, counts = np.array(kinds), np.array(bins or [9] * len(kinds))
    return SimpleNamespace(
        frames=[SimpleNamespace(stratum=kind, position=n) for n, kind in enumerate(kinds)],
        shows_laser=np.isin(values, ["laser", "both"]) & (counts > 0),
        shows_arc=np.isin(values, ["arc", "both"]) & (counts > 0),
    )
