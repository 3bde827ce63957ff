import math

import pytest

from validation.figures.roughness import Regime, coherent_share, regime


@pytest.mark.parametrize(
    ("R_q_um", "expected"),
    [(0.0, Regime.SPIKE), (0.01, Regime.SPIKE), (0.1, Regime.BOTH), (1.0, Regime.BOTH), (3.0, Regime.LOBE)],
)
def test_regime_by_roughness_over_wavelength(R_q_um, expected):
    assert regime(R_q_um, 0.690) is expected


def test_the_regimes_limits_in_terms_of_the_coherent_share():
    assert coherent_share(0.025, 1.0, 1.0) == pytest.approx(0.906, abs=0.001)
    assert coherent_share(1.5, 1.0, math.cos(math.radians(80.0))) < 1e-4


@pytest.mark.parametrize(("R_q_um", "wavelength_um"), [(-1.0, 0.69), (math.nan, 0.69), (0.1, 0.0)])
def test_an_impossible_roughness_is_refused(R_q_um, wavelength_um):
    with pytest.raises(ValueError, match="um"):
        regime(R_q_um, wavelength_um)
