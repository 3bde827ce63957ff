"""All hypotheses about a recording, looked at, fitted and weighed."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from noise_model.effects import REGISTRY
from noise_model.effects.effect import Stage
from sim_to_real.evidence.error_model import LinearHypothesis, SizeColumns
from sim_to_real.evidence.hypotheses import Hypothesis, Posterior, UnknownCause
from sim_to_real.evidence.metric import Metric
from sim_to_real.evidence.policy import POLICY
from sim_to_real.evidence.weigh import MIN_NATS, WeightedHypotheses, principal_cosines, weigh
from sim_to_real.fit.covariates import covariates
from sim_to_real.fit.gauss_newton import refit
from sim_to_real.search.score_test import ScoreTest
from tests.sim_to_real.small import small_recording

FINE = 3
"""So fine a camera resolves the stripe."""

N = 400
A, B, C, NUISANCE = np.random.default_rng(7).standard_normal((4, N))


def looked(name, *columns):
    """An effect that was looked at one place each, half a unit of the first parameter away."""
    return ScoreTest(name, 1.0, np.column_stack(columns), {}, np.full((len(columns), 1), 0.5))


def weighed(nuisances, *scores):
    """What was weighed with noise of unit variance, with nuisances of a wide prior."""
    metric = Metric(np.ones(N, dtype=np.float32), np.zeros((1, N)))
    errors = SimpleNamespace(metric=metric)
    start = LinearHypothesis(np.zeros(N), SizeColumns.free((1e3 * nuisances).astype(np.float32)))
    return WeightedHypotheses(None, scores, errors, start, np.arange(N))


def test_effects_that_a_nuisance_makes_alike_are_a_pair():
    scores = looked("arc_length", A), looked("arc_radius", -2.0 * A + 30.0 * NUISANCE), looked("gamma", B)
    assert weighed(NUISANCE[:, None], *scores).not_resolvable == (("arc_length", "arc_radius"),)
    assert weighed(np.zeros((N, 1)), *scores).not_resolvable == ()


def test_one_that_lies_within_the_span_of_another_cannot_be_told_from_it():
    scores = looked("arc_length", A + B), looked("hand_eye", A, B), looked("gamma", C)
    assert weighed(NUISANCE[:, None], *scores).not_resolvable == (("arc_length", "hand_eye"),)


def test_the_least_that_shows_has_so_many_nats():
    least = weighed(np.zeros((N, 1)), looked("arc_length", A)).smallest["arc_length"]
    assert 0.5 * (least.value / 0.5) ** 2 * float(A @ A) == pytest.approx(MIN_NATS)
    assert least.unit == "mm"
    # An end is a place, and has no smallest magnitude.
    end = ScoreTest("uneven_fan", 1.0, A[:, None], {}, np.zeros((1, 3)))
    assert weighed(np.zeros((N, 1)), end).smallest == {}


def test_what_is_refuted_leaves_its_probability_to_all_others():
    none, gamma, fume = (
        Hypothesis(SimpleNamespace(ids=ids), nats, nats, None, {})
        for ids, nats in (((), 0.0), (("gamma",), 3000.0), (("fume",), 500.0))
    )
    unknown = UnknownCause({(Stage.SENSOR, "rows"): 900.0})
    scores = looked("gamma", A), looked("fume", B)
    posterior = Posterior.of(none, [gamma, fume], unknown, len(scores), POLICY)
    before = replace(weighed(np.zeros((N, 1)), *scores), posterior=posterior)
    after = before.without(gamma).posterior
    assert posterior.p[0] > 0.99
    assert after.hypotheses == (fume,)
    assert after.p_unknown > 0.99
    assert after.p_none + after.p_unknown + sum(after.p) == pytest.approx(1.0)


def test_cosines_are_those_between_the_spans():
    first, second = np.column_stack([A, B]), np.column_stack([A + 0.1 * C])
    cosines = principal_cosines(first.T @ first, first.T @ second, second.T @ second)
    basis, _ = np.linalg.qr(first)
    expected = np.linalg.norm(basis.T @ second[:, 0]) / np.linalg.norm(second)
    assert cosines == pytest.approx([expected])


def of_recording(path, hidden, without=()):
    expected = small_recording(path, hidden, coarser=FINE)
    before = refit(expected, {}, expected.neutral)
    return weigh(expected, before, covariates(expected, before), without, lambda text, share: None).posterior


@pytest.mark.slow
def test_without_an_effect_no_gap_is_likeliest(tmp_path):
    posterior = of_recording(tmp_path / "quiet", {})
    assert posterior.p_none > 0.9


@pytest.mark.slow
def test_an_effect_is_likelier_than_all_else_and_withheld_the_cause_is_unknown(tmp_path):
    """About a fit with the effect, no gap goes along derivatives without it: no level stands for it."""
    hidden = {"gamma": {"gamma": 1.25}}
    known, withheld = (
        of_recording(tmp_path / name, hidden, without=without)
        for name, without in (("known", ()), ("withheld", ("gamma",)))
    )
    assert known.hypotheses[0].ids == ("gamma",)
    assert known.of_effects["gamma"] > 0.99
    assert withheld.p_unknown > 0.9
    assert all("gamma" not in hypothesis.ids for hypothesis in withheld.hypotheses)
    gain = known.hypotheses[0].evidence - known.none.evidence
    assert gain > 100.0
    assert known.unknown.evidence == pytest.approx(withheld.unknown.evidence, abs=0.05 * gain)


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
    assert first.posterior.p == again.posterior.p
    assert first.posterior.unknown == again.posterior.unknown
