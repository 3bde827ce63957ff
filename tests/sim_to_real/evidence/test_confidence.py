"""How probable it is that what leads mimics nothing unknown, and that each of two effects is there."""

import math
from types import SimpleNamespace

import pytest
from scipy.special import expit

from noise_model.effects.effect import Stage
from sim_to_real.evidence.confidence import cause_probability, closed_in_bins, need_probability
from sim_to_real.evidence.hypotheses import Hypothesis, Posterior, UnknownCause
from sim_to_real.evidence.policy import POLICY, CausePolicy, NeedPolicy

TERM = Stage.OPTICS, "light over the image"
PLAIN = CausePolicy(1.0, -0.1, -0.01, -2.0, (-10.0, 30.0), (-200.0, 50.0))


def posterior(nats, left, beside=None, unknown=50.0, before=5.0):
    def hypothesis(nats, mean_square, *ids, with_unknown=None):
        added = None if with_unknown is None else UnknownCause({TERM: with_unknown})
        fitted = SimpleNamespace(ids=ids, mean_square=mean_square)
        return Hypothesis(fitted, nats, nats, None, {}, added)

    leader = hypothesis(nats, left, "gamma", with_unknown=beside)
    none = hypothesis(0.0, before)
    return leader, Posterior.of(none, [leader], UnknownCause({TERM: unknown}), 10, POLICY)


def test_the_share_closed_in_bins_is_of_the_root_of_the_excess():
    leader, of_all = posterior(100.0, 2.0)
    assert closed_in_bins(leader, of_all) == pytest.approx(1.0 - math.sqrt(1.0 / 4.0))
    # Less than the floor is all that can be closed, and lowers the floor.
    leader, of_all = posterior(100.0, 0.5)
    assert closed_in_bins(leader, of_all) == 1.0


def test_log_odds_are_linear_in_nats_and_in_what_stays_open():
    leader, of_all = posterior(100.0, 2.0, beside=96.0, unknown=50.0)
    assert cause_probability(leader, of_all, PLAIN) == pytest.approx(expit(1.0 + 0.4 + 0.5 - 1.0))
    leader, of_all = posterior(100.0, 1.0, beside=500.0, unknown=-500.0)
    assert cause_probability(leader, of_all, PLAIN) == pytest.approx(expit(1.0 - 3.0 + 2.0))


def test_where_there_was_no_gap_nothing_stays_open():
    leader, of_all = posterior(3.0, 0.5, beside=-2.0, unknown=-1.0, before=0.5)
    assert math.isnan(closed_in_bins(leader, of_all))
    assert cause_probability(leader, of_all, PLAIN) == pytest.approx(expit(1.0 + 0.5 + 0.04))


def test_nothing_is_called_surer_than_checks_have_shown():
    leader, of_all = posterior(1e5, 0.5, beside=-1e5, unknown=-1e5)
    assert 0.95 < cause_probability(leader, of_all, POLICY.cause) < 0.99


def two(nats, alone, beside):
    """A posterior in which both effects lead, one of them fitted alone, too."""

    def hypothesis(nats, *ids, with_unknown=None):
        added = None if with_unknown is None else UnknownCause({TERM: with_unknown})
        return Hypothesis(SimpleNamespace(ids=ids, mean_square=1.0), nats, nats, None, {}, added)

    both, one = hypothesis(nats, "gamma", "fume", with_unknown=beside), hypothesis(alone, "fume")
    return both, Posterior.of(hypothesis(0.0), [both, one], UnknownCause({TERM: 5.0}), 10, POLICY)


def test_one_of_two_effects_is_as_probable_as_the_other_lacks_it():
    plain = NeedPolicy(-2.0, 1.5, -0.1, (-10.0, 30.0))
    both, of_all = two(100.0, 60.0, 96.0)
    assert need_probability("gamma", both, of_all, plain) == pytest.approx(
        expit(-2.0 + 1.5 * math.log(40.0) + 0.4)
    )
    # The other one was not fitted alone: no gap is what is left.
    assert need_probability("fume", both, of_all, plain) == pytest.approx(
        expit(-2.0 + 1.5 * math.log(100.0) + 0.4)
    )
    # An unknown cause beside both: the second stands for what the first lacks.
    both, of_all = two(100.0, 99.5, 500.0)
    assert need_probability("gamma", both, of_all, plain) == pytest.approx(expit(-2.0 - 3.0))


def test_an_effect_that_leads_alone_is_needed():
    leader, of_all = posterior(100.0, 2.0)
    assert need_probability("gamma", leader, of_all, POLICY.need) == 1.0
