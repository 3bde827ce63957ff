"""Probability that the effects which lead are there, given all that could mimic them."""

import math

from scipy.special import expit

from sim_to_real.evidence.hypotheses import Hypothesis, Posterior
from sim_to_real.evidence.policy import CausePolicy


def cause_probability(leader: Hypothesis, posterior: Posterior, policy: CausePolicy) -> float:
    """Return the probability that a leading hypothesis' effects are there and mimic nothing unknown.

    It is a logistic regression on opened blind checks, in which half of the leading effects' causes were in
    the catalogue and half were withheld (`CausePolicy`).
    """
    added, closed = leader.with_unknown, closed_in_bins(leader, posterior)
    more_nats = -math.inf if added is None else added.evidence - leader.evidence
    alone_nats = posterior.unknown.evidence - leader.evidence
    ln_odds = (
        policy.ln_odds
        + policy.per_nat_added * min(max(more_nats, policy.added_nats[0]), policy.added_nats[1])
        + policy.per_nat_alone * min(max(alone_nats, policy.alone_nats[0]), policy.alone_nats[1])
        + policy.per_open_share * (min(max(1.0 - closed, 0.0), 1.0) if math.isfinite(closed) else 0.0)
    )
    return float(expit(ln_odds))


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
