"""What effects do to the tracker's seam is what is left of it once the tracker knows them."""

import pytest

from sim_to_real.data.binned import observe
from sim_to_real.decision.seam_error import seam_errors_mm
from sim_to_real.fit.gauss_newton import refit
from sim_to_real.fit.linearized_model import LinearizedModel
from tests.sim_to_real.small import recorded


def errors_mm(path, hidden, **camera):
    """What the tracker's seam is off if effects are hidden from it, and once it knows them."""
    setup, frames, pose_at = recorded(path, hidden, **camera)
    expected = LinearizedModel(observe(setup, frames, pose_at))
    expected = expected.anchored_at(expected.neutral, hidden)
    true = refit(expected, hidden, expected.neutral, steps=0)
    return seam_errors_mm(setup, frames, pose_at, expected, true).total_mm


@pytest.mark.slow
def test_a_camera_that_is_off_moves_the_seam_until_it_is_known(tmp_path):
    before, after = errors_mm(tmp_path / "off", {"hand_eye": {"rot_z_deg": 0.5, "move_x_mm": -0.7}})
    assert before > 0.5
    assert after < 0.1


@pytest.mark.slow
def test_a_clock_that_is_late_moves_the_seam_until_it_is_known(tmp_path):
    """The torch weaves by millimetres: a tenth of a second is up to a millimetre beside the seam."""
    before, after = errors_mm(tmp_path / "late", {"pose_delay": {"delay_s": 0.1}}, coarser=3)
    assert before > 0.5
    assert after < 0.1
