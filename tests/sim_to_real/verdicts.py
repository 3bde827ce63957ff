"""Candidates that verdicts are about, and frames, without the fits behind them."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from noise_model.effects import REGISTRY
from sim_to_real.search.hypothesis import likelihood_nats


@dataclass
class Fitted:
    """The part of a `Candidate` that a verdict asks for."""

    ids: tuple[str, ...]
    left: float
    refit: SimpleNamespace
    evidence: float
    of_bins: float
    left_in_pixels: float = np.nan
    is_held_back: bool = False


def candidate(*ids, left=1.0):
    effects = {name: REGISTRY[name].complete(REGISTRY[name].typical) for name in ids}
    residuals = np.full(4, np.sqrt(left))
    fit = SimpleNamespace(
        ids=ids, residuals=residuals, nuisance=None, effects=effects, change=None, mean_square=left
    )
    return Fitted(ids, left, fit, likelihood_nats(left), likelihood_nats(left))


def seen(kinds, bins=None):
    """Frames of these kinds, of which so many bins count in each; 9 if nothing is said."""
    of, counts = np.array(kinds), np.array(bins or [9] * len(kinds))
    return SimpleNamespace(
        frames=[SimpleNamespace(stratum=kind, position=n) for n, kind in enumerate(kinds)],
        shows_laser=np.isin(of, ["laser", "both"]) & (counts > 0),
        shows_arc=np.isin(of, ["arc", "both"]) & (counts > 0),
    )
