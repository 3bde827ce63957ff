"""The posterior over hypotheses, and the verdict that it gives."""

from types import SimpleNamespace

import numpy as np
import pytest

from noise_model.effects.effect import Stage
from sim_to_real.diagnosis import DiagnosisVerdict
from sim_to_real.evidence.hypotheses import Hypothesis, Posterior, UnknownCause
from sim_to_real.evidence.policy import Policy
from sim_to_real.evidence.weigh import judge

POLICY = Policy(temperature=1.0, ln_odds_effect=0.0, ln_odds_further=-2.0, ln_odds_unknown=-1.0)
TERM = Stage.SURFACE, "arc over the half angle"


def hypothesis(nats, *ids, off=None, with_unknown=None, left=1.0):
    """Evidence of effects that leave a mean square in the bins, of 5 without them."""
    unknown = None if with_unknown is None else UnknownCause({TERM: with_unknown})
    fitted = SimpleNamespace(ids=ids, mean_square=left)
    return Hypothesis(fitted, nats, nats if off is None else off, None, {}, unknown)


def posterior(*hypotheses, none=0.0, unknown=-20.0, n_effects=10):
    no_gap = hypothesis(none, left=5.0)
    return Posterior.of(no_gap, hypotheses, UnknownCause({TERM: unknown}), n_effects, POLICY)


def test_probabilities_add_up_to_one_likeliest_first():
    weighed = posterior(hypothesis(3.0, "fume"), hypothesis(5.0, "gamma"), unknown=2.0)
    assert weighed.p_none + sum(weighed.p) + weighed.p_unknown == pytest.approx(1.0)
    assert [h.ids for h in weighed.hypotheses] == [("gamma",), ("fume",)]
    # 5 nats over no gap, of ten effects that share its odds.
    assert weighed.p[0] / weighed.p_none == pytest.approx(np.exp(5.0) / 10.0)
    assert weighed.p_unknown / weighed.p_none == pytest.approx(np.exp(2.0 - 1.0))


def test_a_further_effect_has_odds_of_its_own():
    weighed = posterior(hypothesis(5.0, "gamma"), hypothesis(9.0, "gamma", "fume"))
    assert weighed.p[0] / weighed.p[1] == pytest.approx(np.exp(5.0 - 9.0 + 2.0) * 10.0)
    assert weighed.of_effects["gamma"] == pytest.approx(sum(weighed.p))
    assert weighed.of_effects["fume"] == pytest.approx(weighed.p[1])


def test_an_unknown_cause_beside_effects_has_the_odds_of_a_further_one():
    weighed = posterior(hypothesis(5.0, "gamma", with_unknown=9.0), hypothesis(4.0, "fume"))
    assert weighed.p_with_unknown == (pytest.approx(weighed.p[0] * np.exp(9.0 - 5.0 - 2.0 - 1.0)), 0.0)
    assert weighed.p_unknown == pytest.approx(weighed.p_alone + weighed.p_with_unknown[0])
    assert weighed.p_none + sum(weighed.p) + weighed.p_unknown == pytest.approx(1.0)
    # What an unknown cause has to help does not count as the effect's.
    assert weighed.of_effects["gamma"] == weighed.p[0]
    assert weighed.of_each["gamma"] == weighed.p[0] + weighed.p_with_unknown[0]


def test_a_form_may_be_exact_or_off():
    assert hypothesis(4.0, "gamma", off=4.0).evidence == pytest.approx(4.0)
    assert hypothesis(4.0, "gamma", off=-90.0).evidence == pytest.approx(4.0 - np.log(2.0))
    assert hypothesis(-90.0, "gamma", off=4.0).evidence == pytest.approx(4.0 - np.log(2.0))


def test_of_several_terms_an_unknown_cause_is_the_mean():
    two = UnknownCause({TERM: 3.0, (Stage.SENSOR, "rows"): -50.0})
    assert two.evidence == pytest.approx(3.0 - np.log(2.0))
    assert two.likeliest == TERM


def test_a_stage_is_as_probable_as_all_its_terms_together():
    # What is of no stage may be likelier than all, and says nothing of the stage.
    terms = {(None, "anything"): 9.0, (Stage.SENSOR, "rows"): 3.0, (Stage.SENSOR, "grey level"): 3.0}
    unknown = UnknownCause({**terms, TERM: 3.0, (Stage.OPTICS, "light over the image"): -300.0})
    assert unknown.likeliest == (None, "anything")
    stages = unknown.stages(2.0)
    assert list(stages) == ["sensor", "surface", "optics"]
    assert stages["sensor"] / stages["surface"] == pytest.approx(2.0**0.5)
    assert stages["optics"] < 1e-9
    assert sum(stages.values()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("hypotheses", "unknown", "verdict", "named", "ambiguous"),
    [
        ((), -20.0, DiagnosisVerdict.NO_GAP, (), ()),
        ((hypothesis(1.0, "gamma"),), -20.0, DiagnosisVerdict.NO_GAP, (), ()),
        (
            (hypothesis(20.0, "gamma"), hypothesis(3.0, "fume", left=1.5)),
            4.0,
            DiagnosisVerdict.EFFECTS,
            ("gamma",),
            (),
        ),
        # Both leave the same pictures; or hardly anything but what was there before.
        (
            (hypothesis(20.0, "gamma"), hypothesis(3.0, "fume")),
            4.0,
            DiagnosisVerdict.AMBIGUOUS,
            (),
            (("gamma", "fume"),),
        ),
        (
            (hypothesis(20.0, "gamma", left=4.8), hypothesis(3.0, "fume", left=4.8)),
            4.0,
            DiagnosisVerdict.EFFECTS,
            ("gamma",),
            (),
        ),
        ((hypothesis(20.0, "gamma"),), 30.0, DiagnosisVerdict.UNKNOWN, (), ()),
        # An unknown cause beside a mimic explains more than the mimic alone, or does not.
        ((hypothesis(20.0, "gamma", with_unknown=26.0),), 4.0, DiagnosisVerdict.UNKNOWN, ("gamma",), ()),
        ((hypothesis(20.0, "gamma", with_unknown=26.0),), 40.0, DiagnosisVerdict.UNKNOWN, (), ()),
        ((hypothesis(20.0, "gamma", with_unknown=16.0),), 4.0, DiagnosisVerdict.EFFECTS, ("gamma",), ()),
        (
            (hypothesis(20.0, "gamma"), hypothesis(19.5, "fume"), hypothesis(9.0, "defocus")),
            4.0,
            DiagnosisVerdict.AMBIGUOUS,
            (),
            (("gamma", "fume"),),
        ),
        (
            (hypothesis(20.0, "gamma"), hypothesis(60.0, "gamma", "fume")),
            4.0,
            DiagnosisVerdict.EFFECTS,
            ("gamma", "fume"),
            (),
        ),
    ],
)
def test_what_leads_is_the_verdict(hypotheses, unknown, verdict, named, ambiguous):
    judgement = judge(posterior(*hypotheses, unknown=unknown), POLICY)
    assert judgement.verdict is verdict
    assert set(judgement.named) == set(named)
    assert judgement.ambiguous == ambiguous
    if named:
        assert set(judgement.leader.ids) == set(named)


def test_an_effect_that_all_likely_hypotheses_share_is_named_alone():
    """Whether fume is there too is open; gamma is there either way."""
    weighed = posterior(hypothesis(20.0, "gamma"), hypothesis(24.0, "gamma", "fume"))
    judgement = judge(weighed, POLICY)
    assert judgement.verdict is DiagnosisVerdict.EFFECTS
    assert judgement.named == ("gamma",)
    assert judgement.leader.ids == ("gamma",)


def test_a_second_effect_that_is_hardly_needed_is_not_named():
    """It is likelier by what the form of the first may lack."""
    both = hypothesis(45.0, "gamma", "fume", with_unknown=46.0)
    judgement = judge(posterior(hypothesis(20.0, "gamma"), both), POLICY)
    assert judgement.verdict is DiagnosisVerdict.EFFECTS
    assert judgement.named == judgement.leader.ids == ("gamma",)
