"""How long compiling takes yet is what the machine needed before, for what it must compile anew."""

from pathlib import Path

import pytest
from test_kernel_store import folder, forget  # noqa: F401

from noise_model.compiled.forecast import Forecast
from noise_model.kernel import kernel


@kernel
def halved(x: float) -> float:
    """Return the half."""
    return 0.5 * x


@pytest.mark.slow
def test_what_is_left_is_what_must_be_compiled_anew(folder: Path) -> None:  # noqa: F811
    assert Forecast("v_groove").left_s() is None, "never done here"
    assert halved(3.0) == 1.5
    Forecast("v_groove").keep()
    assert Forecast("v_groove").left_s() == 0.0
    for kept in folder.glob("*.halved/*"):
        kept.unlink()
    forecast = Forecast("v_groove")
    assert 0.0 < forecast.left_s() < 60.0
    forecast.note_compiled(f"{__name__}.halved")
    assert forecast.left_s() == 0.0
