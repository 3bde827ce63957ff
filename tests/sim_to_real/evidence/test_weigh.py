"""All hypotheses about a recording, looked at, fitted and weighed."""

import pytest

from noise_model.effects import REGISTRY
from sim_to_real.evidence.weigh import weigh
from sim_to_real.fit.gauss_newton import refit
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.locate.covariates import covariates
from tests.sim_to_real.small import small_recording

FINE = 3
"""So fine a camera resolves the stripe."""


def with_rim(expected):
    """The model with the light of the stripe's rim, about its neutral nuisances."""
    whole = LinearizedModel(expected.observed.with_stripe_rim())
    return whole.anchored_at(whole.neutral, {})


def of_recording(path, hidden, without=()):
    expected = with_rim(small_recording(path, hidden, coarser=FINE))
    before = refit(expected, {}, expected.neutral)
    return weigh(expected, before, covariates(expected, before), without, lambda text, share: None)


@pytest.mark.slow
def test_without_an_effect_no_gap_is_likeliest(tmp_path):
    posterior = of_recording(tmp_path / "quiet", {})
    assert posterior.p_none > 0.5


@pytest.mark.slow
def test_an_effect_is_likelier_than_all_else_and_withheld_the_cause_is_unknown(tmp_path):
    hidden = {"gamma": {"gamma": 1.25}}
    posterior = of_recording(tmp_path / "gamma", hidden)
    assert "gamma" in posterior.hypotheses[0].ids
    assert posterior.of_effects["gamma"] > 0.99
    withheld = of_recording(tmp_path / "again", hidden, without=("gamma",))
    assert withheld.p_unknown > 0.9
    assert all("gamma" not in hypothesis.ids for hypothesis in withheld.hypotheses)


@pytest.mark.slow
def test_of_two_effects_both_are_likelier_than_one(tmp_path):
    hidden = {"gamma": {"gamma": 1.15}, "veiling_glare": {"share": 0.1}}
    posterior = of_recording(tmp_path / "both", hidden)
    assert set(posterior.hypotheses[0].ids) == set(hidden)


@pytest.mark.slow
def test_what_was_asked_before_does_not_change_the_answer(tmp_path):
    """Fits anchor the model anew; the next question begins from the same place."""
    expected = small_recording(tmp_path / "twice", {"arc_length": {"height_mm": 0.6}})
    before = refit(expected, {}, expected.neutral)
    values = covariates(expected, before)
    others = [name for name in REGISTRY if name not in ("arc_length", "arc_radius")]
    first, again = (weigh(expected, before, values, others, lambda text, share: None) for _ in range(2))
    assert first.p == again.p
    assert first.unknown == again.unknown
