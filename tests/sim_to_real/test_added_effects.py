"""Effects added to a setup close the gap of frames that no fit has seen, if they are its cause."""

import numpy as np
import pytest

from arctrack.simulation.simulate import SimulationPlan
from noise_model.effects import checked
from sim_to_real.added_effects import predict_with_added
from tests.sim_to_real.small import recorded

pytestmark = pytest.mark.slow

TUESDAY = SimulationPlan(frames=14, seam_wander_mm=0.1, seed=5, weave_mm=2.0)


def added(recording, effects):
    return predict_with_added(*recording, checked(effects), lambda text, share: None)


@pytest.fixture(scope="module")
def bent(tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("added") / "r", {"gamma": {"gamma": 1.3}}, TUESDAY, coarser=4)


def test_the_cause_closes_the_gap_without_being_fitted(bent):
    gap = added(bent, {"gamma": {"gamma": 1.3}}).gap
    assert gap.before > 10.0 * gap.floor
    # All of it: what is left lies below the floor.
    assert gap.after < gap.floor
    assert gap.closed == gap.ci95[0] == gap.ci95[1] == 1.0
    assert not gap.explains_nothing


def test_a_parameter_that_is_off_closes_less(bent):
    """Nothing of the effect is fitted anew: a wrong value stays wrong."""
    assert (
        added(bent, {"gamma": {"gamma": 1.15}}).gap.closed
        < added(bent, {"gamma": {"gamma": 1.3}}).gap.closed - 0.2
    )


def test_another_effect_closes_nothing(bent):
    gap = added(bent, {"gamma": {"gamma": 0.8}}).gap
    assert gap.explains_nothing
    assert gap.after > gap.before


def test_the_gap_is_that_of_frames_that_gave_no_nuisance(bent):
    result = added(bent, {"gamma": {"gamma": 1.3}})
    _, frames, _ = bent
    assert len(result.predicted.frames) + result.n_fitted == len(frames)
    counts = np.isfinite(result.predicted.variance)
    assert np.array_equal(counts, np.isfinite(result.predicted.variance_after))
    for mean, gap in (
        (result.predicted.before, result.gap.before),
        (result.predicted.after, result.gap.after),
    ):
        r2 = ((result.predicted.recorded - mean) ** 2 / result.predicted.variance_after)[counts]
        assert np.sqrt(max(r2.mean(dtype=np.float64) - 1.0, 0.0)) == pytest.approx(gap, rel=1e-3)


def test_frames_have_their_own_level_where_the_arc_flickers(tmp_path):
    """No setup states each frame's level: known alone how much it varies, a gap would stay."""
    recording = recorded(tmp_path / "r", {"arc_flicker": {"sigma_rel": 0.15}}, TUESDAY, coarser=4)
    gap = added(recording, {"arc_flicker": {"sigma_rel": 0.15}}).gap
    assert gap.closed > 0.7
