"""The first look at two effects at a time."""

import itertools

import numpy as np
import pytest
from small import small_recording

from noise_model.effects import REGISTRY
from sim_to_real.fit.gauss_newton import refit
from sim_to_real.search.hypothesis import bic_penalty_nats, likelihood_nats
from sim_to_real.search.score_test import score_effects, score_flicker, solve_along
from sim_to_real.search.score_test_pairs import score_pairs

TRIED = ["gamma", "veiling_glare", "wrong_material", "fume", "dirty_window", "black_level", "blooming"]


def looked(path, hidden):
    expected = small_recording(path / "both", hidden)
    baseline = refit(expected, {}, expected.neutral, steps=0)
    return expected, baseline, score_effects(expected, baseline, TRIED)


@pytest.mark.slow
def test_two_effects_are_seen_though_others_seem_likelier_than_one_of_them(tmp_path):
    hidden = {"gamma": {"gamma": 1.15}, "veiling_glare": {"share": 0.1, "spread": 0.8}}
    _, baseline, screened = looked(tmp_path, hidden)
    assert "veiling_glare" not in [item.id for item in screened[:4]]
    best, second = score_pairs(baseline, screened, 2)
    assert set(best.starts) == set(hidden)
    assert best.evidence > second.evidence + 3.0
    assert best.starts["gamma"]["gamma"] == pytest.approx(1.15, abs=0.03)
    assert best.starts["veiling_glare"]["share"] == pytest.approx(0.1, abs=0.03)


@pytest.mark.slow
def test_the_best_pairs_are_those_of_all_that_are_tried_one_by_one(tmp_path):
    hidden = {"gamma": {"gamma": 1.15}, "black_level": {"offset_dn": 3.0}}
    expected, baseline, screened = looked(tmp_path, hidden)
    looks = [*screened, score_flicker(expected, baseline)]
    wanted = {}
    for item, other in itertools.combinations(looks, 2):
        values = []
        for a, b in itertools.product(item.families, other.families):
            columns = np.hstack([a.signature, b.signature])
            mean_square, _ = solve_along(
                baseline, baseline.residuals, columns, [*a.step_limits(), *b.step_limits()]
            )
            values.append(likelihood_nats(mean_square * baseline.mean_square))
        cost = bic_penalty_nats(item.n_parameters + other.n_parameters)
        wanted[frozenset((item.id, other.id))] = max(values) - cost
    result = {frozenset(pair.starts): pair.evidence for pair in score_pairs(baseline, looks, 3)}
    assert list(result.values()) == pytest.approx([wanted[ids] for ids in result])
    assert list(result.values()) == pytest.approx(sorted(wanted.values(), reverse=True)[:3])


@pytest.mark.slow
def test_a_pair_starts_within_bounds(tmp_path):
    _, baseline, screened = looked(tmp_path, {"gamma": {"gamma": 1.6}, "blooming": {"spill": 0.9}})
    for pair in score_pairs(baseline, screened, 5):
        for name, values in pair.starts.items():
            assert all(
                given.lower <= values[given.name] <= given.upper for given in REGISTRY[name].parameters
            )
