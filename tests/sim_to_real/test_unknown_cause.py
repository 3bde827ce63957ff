"""An unknown cause is described by what it depends on, and an experiment is always asked for."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim_to_real import diagnose as diagnosing
from sim_to_real.decision.describe_unknown import unexplained_curve
from sim_to_real.decision.experiments import MENU, MORE_OF_UNKNOWN
from sim_to_real.decision.unknown_experiment import CHANGES, TELLS
from sim_to_real.decision.unknown_terms import TRAITS, likely_terms, rival_terms
from sim_to_real.diagnose import diagnose
from sim_to_real.diagnosis import DiagnosisVerdict
from sim_to_real.evidence.coordinates import free_terms
from sim_to_real.evidence.free_functions import FreeFunctions, all_families
from sim_to_real.evidence.policy import POLICY
from tests.sim_to_real.evidence.test_free_functions import (
    beside_levels,
    compared_of,
    errors_of,
    noise,
)
from tests.sim_to_real.planted import planted
from tests.sim_to_real.small import EXACT, recorded


@pytest.fixture(scope="module")
def bins():
    return planted(n_frames=24, shape=(24, 32))


def named_dn(bins):
    """What some named effect changes, DN."""
    return 6.0 * np.exp(-(((bins.values["column"] - 20.0) / 4.0) ** 2))


def test_every_term_says_what_it_depends_on(bins):
    terms = {term.name for term in free_terms(bins).terms if term.stage is not None and len(term.blocks) == 1}
    assert len(terms) > 20
    assert terms <= set(TRAITS)
    keys = {experiment.key for experiment in (*MENU, *MORE_OF_UNKNOWN)}
    assert keys == set(TELLS)
    assert {traits.coordinate for traits in TRAITS.values()} == set(CHANGES)
    assert {key for changed in CHANGES.values() for key in changed} < keys


@pytest.mark.parametrize("is_beside", [False, True])
def test_an_unknown_function_is_described_by_its_covariate_and_its_curve(bins, is_beside):
    """Alone, and beside a larger effect that is named: waves of any phase about their mean."""
    errors, families = errors_of(bins), all_families(bins, compared_of(bins))
    lit = bins.subset(compared_of(bins))
    lit = lit.subset(np.flatnonzero(np.isfinite(lit.values["distance"])))
    distance, weights = lit.values["distance"].astype(np.float64), lit.arc_dn.astype(np.float64) ** 2
    held = []
    for seed in range(4):

        def share(at, seed=seed):
            return 0.1 * np.sin(2.0 * np.pi * at / (1.2 * np.ptp(distance)) + 1.5 * seed)

        unknown_dn = share(np.nan_to_num(bins.values["distance"])) * bins.arc_dn
        residuals = noise(bins, seed) + unknown_dn + is_beside * named_dn(bins)
        none = beside_levels(bins, residuals)
        named = beside_levels(bins, residuals, named_dn(bins)) if is_beside else none
        curve = unexplained_curve(FreeFunctions.of(errors, families, none, named, POLICY))
        assert (curve.name, curve.form) == ("distance", "times_arc")
        assert curve.r2 > 0.8
        true = share(curve.centers) - np.average(share(distance), weights=weights)
        held += list((curve.low <= true) & (true <= curve.high))
        assert np.median(curve.high - curve.low) < 0.1
        first, *others = likely_terms(named, errors, POLICY)
        assert (first.stage, first.name, first.source) == ("medium", "arc over the distance", "arc")
        assert first.probability > 0.9
        assert first.share > 0.8
        assert max(term.nats for term in others) < first.nats - 50.0
    assert np.mean(held) > 0.85


def test_terms_of_different_kinds_are_told_apart(bins):
    residuals = noise(bins) + 4.0 * np.sin(0.5 * bins.frame)
    terms = likely_terms(beside_levels(bins, residuals), errors_of(bins), POLICY)
    assert terms[0].name == "offset in each frame"
    rivals = rival_terms(terms)
    assert rivals[0] is terms[0]
    assert len({term.coordinate for term in rivals}) == len(rivals) == 3


@pytest.mark.slow
def test_a_withheld_cause_is_described_and_an_experiment_asked_for(tmp_path, monkeypatch):
    """No effect counts as the whole cause, so the unknown's own terms choose the experiment."""
    monkeypatch.setattr(diagnosing, "has_rivals", lambda weighed: False)
    recording = recorded(tmp_path / "r", {"gamma": {"gamma": 1.35}}, EXACT)
    diagnosis = diagnose(*recording, without=("gamma",))
    assert diagnosis.verdict is DiagnosisVerdict.UNKNOWN
    unknown = diagnosis.unknown
    nats = [term.nats for term in unknown.terms]
    assert nats == sorted(nats, reverse=True)
    assert nats[0] > 50.0
    assert unknown.excess > 0.5
    assert 0 < len(unknown.frames) <= unknown.n_frames
    assert unknown.rows_px[0] <= unknown.rows_px[1]
    assert all(abs(off_mm) < 3.0 for off_mm in unknown.seam_off_mm)
    assert all(candidate.left_sigma > 0.0 for candidate in diagnosis.ranking if not candidate.is_random)
    asked = diagnosis.next
    assert asked.experiment in {experiment.name for experiment in (*MENU, *MORE_OF_UNKNOWN)}
    # The recording holds dark frames, laser alone and arc alone.
    assert asked.experiment not in {item.name for item in MENU if item.key in ("dark", "laser", "arc")}
    assert asked.reason in TELLS.values()
    assert len(asked.separates) > 1


def test_an_experiment_is_asked_for_where_one_of_a_set_is_hardly_probable(monkeypatch):
    asked = []

    def next_measurement(model, posterior, errors, policy, is_unknown=False):
        asked.append(is_unknown)
        return "an experiment" if is_unknown else None

    monkeypatch.setattr(diagnosing, "next_measurement", next_measurement)
    weighed = SimpleNamespace(posterior=None, errors=None, policy=POLICY)
    assert diagnosing._next(None, weighed, DiagnosisVerdict.AMBIGUOUS) == "an experiment"
    assert diagnosing._next(None, weighed, DiagnosisVerdict.EFFECTS) is None
    assert asked == [False, True, False, False]
