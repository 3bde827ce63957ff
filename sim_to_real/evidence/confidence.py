"""Probability that the effects which lead are there, given all that could mimic them."""

import math

import numpy as np
from scipy.special import expit

from noise_model.compiled.arrays import Float64
from sim_to_real.evidence.hypotheses import Hypothesis, Posterior
from sim_to_real.evidence.policy import CausePolicy, NeedPolicy


def cause_probability(leader: Hypothesis, posterior: Posterior, policy: CausePolicy) -> float:
    """Return the probability that a leading hypothesis' effects are there and mimic nothing unknown.

    It is a logistic regression on opened blind checks (`CausePolicy`).
    """
    added, open_share = leader.with_unknown, 1.0 - closed_in_bins(leader, posterior)
    more_nats = -math.inf if added is None else added.evidence - leader.evidence
    alone_nats = posterior.unknown.evidence - leader.evidence
    return float(expit(cause_features(more_nats, alone_nats, open_share, policy) @ policy.weights))


def cause_features(more_nats: float, alone_nats: float, open_share: float, policy: CausePolicy) -> Float64:
    """Return the regression's inputs (4,), a constant first.

    `more_nats` is by how many nats the effects with an unknown cause are likelier than alone, `alone_nats`
    by how many an unknown cause alone is; `open_share` of the bins' gap stays open, NaN without a gap.
    """
    return np.array(
        [
            1.0,
            np.clip(more_nats, *policy.added_nats),
            np.clip(alone_nats, *policy.alone_nats),
            np.clip(np.nan_to_num(open_share), 0.0, 1.0),
        ]
    )


def need_probability(name: str, leader: Hypothesis, posterior: Posterior, policy: NeedPolicy) -> float:
    """Return the probability that one of two effects that lead is there, given that the other is.

    It is a logistic regression on opened blind checks (`NeedPolicy`); 1 of an effect that leads alone.
    """
    if len(leader.ids) < 2:
        return 1.0
    others = [other for other in leader.ids if other != name]
    fewer = [h.evidence for h in posterior.hypotheses if list(h.ids) == others]
    needed_nats = leader.evidence - max([posterior.none.evidence, *fewer])
    added = leader.with_unknown
    more_nats = -math.inf if added is None else added.evidence - leader.evidence
    return float(expit(need_features(needed_nats, more_nats, policy) @ policy.weights))


def need_features(needed_nats: float, more_nats: float, policy: NeedPolicy) -> Float64:
    """Return the regression's inputs (3,), a constant first.

    `needed_nats` is by how many nats the effects are likelier than without the one in question, `more_nats`
    by how many they are with an unknown cause beside them.
    """
    return np.array([1.0, math.log(max(needed_nats, 1.0)), np.clip(more_nats, *policy.added_nats)])


def gap_in_bins(hypothesis: Hypothesis, posterior: Posterior) -> float:
    """Return what a hypothesis leaves of the bins' gap, sqrt(mean r^2 - 1), in sigmas of a bin.

    Below the model's floor the effect that leaves least closes all.
    """
    floor = min([1.0, *(single.refit.mean_square for single, _ in posterior.singles.values())])
    return math.sqrt(max(hypothesis.refit.mean_square - floor, 0.0))


def closed_in_bins(hypothesis: Hypothesis, posterior: Posterior) -> float:
    """Return the share that a hypothesis closes of the bins' gap; NaN without a gap."""
    gap = gap_in_bins(posterior.none, posterior)
    return 1.0 - gap_in_bins(hypothesis, posterior) / gap if gap else math.nan
