"""The trivial baseline: likeness of the raw residual to each effect's signature."""

import numpy as np
import pytest

from sim_to_real.data.binned import observe
from tests.sim_to_real.small import recorded
from validation.blind_check.cosine import cosine, cosines_of

TRIED = (
    "gamma",
    "black_level",
    "veiling_glare",
    "vignetting",
    "arc_length",
    "hand_eye",
    "spatter",
    "arc_flicker",
    "fume",
)


def test_a_cosine_is_that_of_the_angle():
    a, b = np.array([1.0, 0.0, 0.0]), np.array([1.0, 1.0, 0.0])
    assert cosine(a, b) == pytest.approx(np.sqrt(0.5))
    assert cosine(a, -3.0 * a) == pytest.approx(-1.0)
    assert np.isnan(cosine(a, np.zeros(3)))


@pytest.mark.slow
@pytest.mark.parametrize("planted", [{"gamma": {"gamma": 1.2}}, {"arc_length": {"height_mm": -1.0}}])
def test_a_planted_signature_is_found(planted, tmp_path):
    found = cosines_of(observe(*recorded(tmp_path / "made", planted)), TRIED)
    assert list(found) == list(TRIED)
    # What only scatters frames about their mean has no signature.
    assert np.isnan(found.pop("arc_flicker"))
    name = next(iter(planted))
    assert max(found, key=lambda of: abs(np.nan_to_num(found[of]))) == name
    assert abs(found[name]) > 0.8
