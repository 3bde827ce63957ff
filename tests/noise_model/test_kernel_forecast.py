"""How long compiling takes yet is told by what the machine needed before, else by the release."""

from pathlib import Path

import pytest
from test_kernel_store import folder, forget  # noqa: F401

from noise_model.compiled import forecast as forecast_module
from noise_model.compiled.forecast import Forecast
from noise_model.compiled.kernel import kernel


@kernel
def halved(x: float) -> float:
    """Return the half."""
    return 0.5 * x


@pytest.mark.slow
def test_what_is_left_is_what_must_be_compiled_anew(
    folder: Path,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert Forecast("v_groove").left_s() is None, "never done here"
    assert Forecast("v_groove").counts() is None
    monkeypatch.setattr(forecast_module, "pack_serves", lambda: False)
    assert Forecast("v_groove").lacks_much()
    monkeypatch.setattr(forecast_module, "pack_serves", lambda: True)
    assert not Forecast("v_groove").lacks_much(), "nearly all came with arctrack"
    assert halved(3.0) == 1.5
    Forecast("v_groove").keep()
    assert Forecast("v_groove").left_s() == 0.0
    monkeypatch.setattr(forecast_module, "pack_serves", lambda: False)
    assert not Forecast("lap").lacks_much(), "it shares most with what was done here"
    for kept in folder.glob("*.halved/*"):
        kept.unlink()
    forecast = Forecast("v_groove")
    assert 0.0 < forecast.left_s() < 60.0
    done, needed = forecast.counts() or (1, 0)
    assert done == 0 < needed
    alone_s = forecast.left_s()
    with forecast.shared_by(2) as on_end:
        assert forecast.left_s() == alone_s / 2
        on_end()
        assert forecast.left_s() == alone_s
    assert not forecast.lacks_much()
    monkeypatch.setattr(forecast_module, "MUCH_S", alone_s)
    assert forecast.lacks_much()
    forecast.note_compiled(f"{__name__}.halved")
    assert forecast.left_s() == 0.0
    assert forecast.counts() == (1, needed)


def test_where_nothing_was_compiled_before_the_release_tells_how_much_there_is(
    folder: Path,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(forecast_module, "compile_costs", {"v_groove": {"short": 100, "long": 300}}.get)
    forecast = Forecast("v_groove")
    assert forecast.counts() == (0, 2)
    assert forecast.left_s() is None, "no pace is known"
    monkeypatch.setattr(forecast_module.time, "perf_counter", lambda: forecast._began_s + 2.0)
    forecast.note_compiled("short")
    assert forecast.counts() == (1, 2)
    assert forecast.left_s() == pytest.approx(6.0)
