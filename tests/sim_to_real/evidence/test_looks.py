"""A first look without a fit: what it foretells, and where it lets a fit start."""

import numpy as np
import pytest

from sim_to_real.evidence.error_model import ErrorModel, LinearHypothesis, SizeColumns, probe_sigmas
from sim_to_real.evidence.looks import START_SHARES, Looks
from sim_to_real.evidence.metric import Metric
from sim_to_real.search.score_test import ScoreTest

N = 300
GLARE, OFFSET, NUISANCE = np.random.default_rng(3).standard_normal((3, N))


def family(name, change, step, **shape):
    """An effect that was tried at one probe point of its first parameter."""
    origin = {"share": 0.0, "spread": 0.3} if name == "veiling_glare" else {"offset_dn": 0.0}
    steps = np.zeros((1, len(origin)))
    steps[0, 0] = step
    return ScoreTest(name, 1.0, change[:, np.newaxis], {**origin, **shape}, steps)


@pytest.fixture
def looks():
    """Residuals that 0.02 of glare (from 0.05 tried) and -3 DN (from 2 DN) leave of nothing."""
    residuals = -0.4 * 60.0 * GLARE - (-1.5) * 40.0 * OFFSET
    start = LinearHypothesis(residuals, SizeColumns.free(NUISANCE[:, np.newaxis].astype(np.float32)))
    scores = [family("veiling_glare", 60.0 * GLARE, 0.05), family("black_level", 40.0 * OFFSET, 2.0)]
    metric = Metric(np.ones(N, dtype=np.float32), np.zeros((1, N)))
    return Looks(start, np.zeros(1), scores, ErrorModel(metric, (), {}, np.ones((N, 1), dtype=np.float32)))


def test_sigmas_say_how_far_a_probe_point_is_from_the_prior_s_middle():
    assert probe_sigmas(family("veiling_glare", GLARE, 0.05)) == pytest.approx([0.5])
    assert probe_sigmas(family("black_level", OFFSET, 2.0)) == pytest.approx([0.4])


def test_a_pair_starts_where_both_together_leave_least(looks):
    (pair,) = looks.pairs_alone(needed=50.0)
    assert pair.ids == {"veiling_glare", "black_level"}
    assert pair.starts[0]["veiling_glare"]["share"] == pytest.approx(0.02, rel=0.02)
    assert pair.starts[0]["black_level"]["offset_dn"] == pytest.approx(-3.0, rel=0.02)
    for start, share in zip(pair.starts, START_SHARES, strict=True):
        assert start["black_level"]["offset_dn"] == pytest.approx(
            share * pair.starts[0]["black_level"]["offset_dn"]
        )
    assert looks.pairs_alone(needed=1e9) == []
