"""What effects do to the tracker's seam is what is left of it once the tracker knows them."""

from sim_to_real.expected import Expected
from sim_to_real.observed import observe
from sim_to_real.refit import refit
from sim_to_real.seam_error import seam_errors_mm
from tests.sim_to_real.small import recorded


def test_a_camera_that_is_off_moves_the_seam_until_it_is_known(tmp_path):
    hidden = {"hand_eye": {"rot_z_deg": 0.5, "move_x_mm": -0.7}}
    setup, frames, pose_at = recorded(tmp_path / "off", hidden)
    expected = Expected(observe(setup, frames, pose_at))
    expected.take_tangents(expected.neutral, hidden)
    true = refit(expected, hidden, expected.neutral, steps=0)
    before, after = seam_errors_mm(setup, frames, pose_at, expected, true)
    assert before > 0.5
    assert after < 0.1


def test_a_clock_that_is_late_moves_the_seam_until_it_is_known(tmp_path):
    """The torch weaves by millimetres: a tenth of a second is up to a millimetre beside the seam."""
    hidden = {"pose_delay": {"delay_s": 0.1}}
    setup, frames, pose_at = recorded(tmp_path / "late", hidden, coarser=3)
    expected = Expected(observe(setup, frames, pose_at))
    expected.take_tangents(expected.neutral, hidden)
    true = refit(expected, hidden, expected.neutral, steps=0)
    before, after = seam_errors_mm(setup, frames, pose_at, expected, true)
    assert before > 0.5
    assert after < 0.1
