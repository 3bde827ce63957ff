"""The global p-value of the model."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import kstest

from sim_to_real.decision.model_test import (
    PROBABILITIES,
    QUIET,
    QuietDistribution,
    global_p_value,
    model_test,
)


@pytest.mark.parametrize("name", QUIET)
def test_a_quiet_quantile_has_its_own_probability(name):
    quiet = QUIET[name]
    # Of equal quantiles the last counts.
    got = [quiet.p_value(value) for value in quiet.quantiles]
    assert got[3:] == pytest.approx([1.0 - p for p in PROBABILITIES[3:]])
    assert np.all(np.diff([quiet.p_value(value) for value in np.linspace(-8.0, 8.0, 400)]) <= 0.0)


def test_drawn_values_have_uniform_p_values():
    """Of a standard normal distribution, whose tails are thinner than exponential ones."""
    draw = np.random.default_rng(3)
    quantiles = np.quantile(draw.standard_normal(200_000), PROBABILITIES)
    quiet = QuietDistribution(tuple(quantiles.tolist()), 0.4)
    p = [quiet.p_value(value) for value in draw.standard_normal(2000)]
    assert kstest(p, "uniform").pvalue > 0.05


def test_the_smallest_of_uniform_p_values_is_uniform_again():
    drawn = np.random.default_rng(4).random((3000, 3))
    p = [global_p_value(list(of_one)) for of_one in drawn]
    assert kstest(p, "uniform").pvalue > 0.05
    assert global_p_value([1e-30, 0.5]) == pytest.approx(2e-30)
    assert np.isnan(global_p_value([]))


def posterior(unknown, none=0.0, **effects):
    found = [
        SimpleNamespace(evidence=value, with_unknown=SimpleNamespace(evidence=value + 3.0))
        for value in effects.values()
    ]
    return SimpleNamespace(
        none=SimpleNamespace(evidence=none), unknown=SimpleNamespace(evidence=unknown), hypotheses=found
    )


def test_each_statistic_can_refute_the_model_alone():
    gap, nothing = SimpleNamespace(before=0.1, floor=0.2), SimpleNamespace(evidence={"spatter": -2.2})
    quiet = model_test(gap, posterior(-5.0), nothing)
    assert quiet.p_value > 0.5
    for tested in (
        model_test(SimpleNamespace(before=0.5, floor=0.2), posterior(-5.0), nothing),
        model_test(gap, posterior(-5.0, gamma=9.0), nothing),
        model_test(gap, posterior(-5.0, none=-20.0), nothing),
        model_test(gap, posterior(-5.0), SimpleNamespace(evidence={"spatter": -2.2, "read_noise": 9.0})),
    ):
        assert tested.p_value < 1e-3
        assert sorted(tested.p_values.values())[1] > 0.1


def test_what_has_no_statistic_is_left_out():
    gap = SimpleNamespace(before=np.nan, floor=np.nan)
    tested = model_test(gap, posterior(-5.0), SimpleNamespace(evidence={}))
    assert set(tested.p_values) == {"bins"}
    assert tested.p_value == tested.p_values["bins"]
