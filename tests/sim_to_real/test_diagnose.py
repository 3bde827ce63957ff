"""A recording with a hidden effect is diagnosed: what it is, how large, how far the gap shrinks."""

import numpy as np
import pytest

from arctrack.nominal import nominal_setup
from arctrack.simulate import SimulationPlan
from sim_to_real.diagnose import diagnose
from sim_to_real.diagnosis import Verdict, left_out
from tests.sim_to_real.small import example_setup, recorded

PLAN = SimulationPlan(frames=16, seam_wander_mm=0.1, seed=3)
"""True values are off by their tolerance."""


@pytest.fixture(scope="module")
def with_gamma(tmp_path_factory):
    of = recorded(tmp_path_factory.mktemp("diagnose") / "gamma", {"gamma": {"gamma": 1.3}}, PLAN)
    heard = []
    found = diagnose(*of, on_stage=lambda text, share: heard.append((text, share)))
    return found, heard


def test_a_hidden_gamma_is_named_alone_with_its_value(with_gamma):
    found, _ = with_gamma
    assert found.verdict is Verdict.EFFECTS
    assert [effect.id for effect in found.effects] == ["gamma"]
    assert found.effects[0].parameters["gamma"].value == pytest.approx(1.3, abs=0.03)
    assert found.effects[0].share == pytest.approx(1.0)
    assert found.ranking[0].id == "gamma"


def test_the_gap_can_be_computed_again_from_what_was_predicted(with_gamma):
    found, _ = with_gamma
    predicted = found.predicted
    counts = np.isfinite(predicted.variance)
    r = ((predicted.recorded - predicted.before) ** 2 / predicted.variance)[counts]
    assert found.gap.before == pytest.approx(np.sqrt(r.mean() - 1.0), rel=1e-4)
    # An image 106 pixels wide says little of the seam: what is left is its, not the response's.
    assert found.gap.after < 0.5 * found.gap.before
    assert found.gap.ci95[0] <= found.gap.closed <= found.gap.ci95[1]
    assert found.gap.rms_dn[1] < found.gap.rms_dn[0]


def test_it_says_where_and_how_far_it_is(with_gamma):
    found, heard = with_gamma
    assert found.where.stage == "sensor"
    assert found.where.z.shape == found.predicted.before.shape[1:]
    shares = [share for _, share in heard]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_no_frame_with_a_pose_is_refused(tmp_path):
    setup, frames, _ = recorded(tmp_path / "no_pose", {})
    with pytest.raises(ValueError, match="no frame has a pose"):
        diagnose(setup, frames, lambda t: None)


def test_an_effect_that_is_not_known_is_refused():
    with pytest.raises(ValueError, match="gama: no such effect"):
        diagnose(example_setup(), [], lambda t: None, without=("gama",))


def test_bounced_light_in_a_u_is_no_candidate():
    groove, u = (nominal_setup(joint, "mild_steel") for joint in ("v_groove", "u_groove"))
    assert left_out(groove, ("gamma",)) == ("gamma",)
    assert left_out(u, ("gamma",)) == ("gamma", "interreflection")
    assert left_out(u, ("interreflection",)) == ("interreflection",)
