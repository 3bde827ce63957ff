"""What is sent of a displacement: never beyond the limit, nothing on an axis that is not enabled."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracker.seam.correction import AxisCorrection, Correction, correct

lengths_mm = st.floats(-40.0, 40.0)
displacements_mm = st.tuples(lengths_mm, lengths_mm)


@st.composite
def axes(draw: st.DrawFn) -> AxisCorrection:
    limit_mm = draw(st.floats(0.01, 30.0) | st.just(math.inf))
    bias_mm = draw(st.floats(-1.0, 1.0)) * min(limit_mm, 5.0)
    return AxisCorrection(
        enable=draw(st.booleans()), gain=draw(st.floats(0.01, 1.0)), bias_mm=bias_mm, limit_mm=limit_mm
    )


corrections = st.builds(Correction, y=axes(), z=axes())


@given(displacements_mm)
def test_unless_something_is_stated_the_displacement_is_sent_as_it_is(
    displacement: tuple[float, float],
) -> None:
    corrected = correct(Correction(), displacement)
    np.testing.assert_array_equal(corrected.offset_mm, displacement)
    assert not corrected.is_limited
    assert not corrected.is_stopped


@given(corrections, displacements_mm)
def test_no_correction_passes_its_limit(correction: Correction, displacement: tuple[float, float]) -> None:
    corrected = correct(correction, displacement)
    stated = correction.y, correction.z
    for axis, there_mm, offset_mm in zip(stated, displacement, corrected.offset_mm, strict=True):
        assert math.isnan(offset_mm) is not axis.enable
        assert not abs(offset_mm) > axis.limit_mm
        if not corrected.is_limited and axis.enable:
            assert offset_mm == pytest.approx(axis.gain * there_mm + axis.bias_mm)


@given(corrections, displacements_mm, displacements_mm)
def test_a_correction_never_moves_further_than_the_seam(
    correction: Correction, one: tuple[float, float], other: tuple[float, float]
) -> None:
    """Continuous everywhere, at the limit too."""
    a, b = (np.array(correct(correction, each).offset_mm) for each in (one, other))
    known = np.array(correction.enabled)
    assert (np.abs(a - b)[known] <= np.abs(np.subtract(one, other))[known] + 1e-12).all()


@given(corrections, displacements_mm, lengths_mm)
def test_the_axes_know_nothing_of_each_other(
    correction: Correction, displacement: tuple[float, float], z_mm: float
) -> None:
    """The arc-voltage control owns the height: whatever z does, it stays unknown and y stays what it is."""
    free = replace(correction, z=replace(correction.z, enable=False))
    offset_mm = correct(free, displacement).offset_mm
    elsewhere = correct(free, (displacement[0], z_mm)).offset_mm
    np.testing.assert_array_equal(offset_mm, elsewhere)
    assert math.isnan(offset_mm[1])


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_correction_at_its_limit_passes_and_one_beyond_stops_both_axes(sign: float) -> None:
    correction = Correction(y=AxisCorrection(limit_mm=2.0, at_limit="stop"))
    at, beyond = (2.0 * sign, 0.5), (math.nextafter(2.0, 3.0) * sign, 0.5)
    np.testing.assert_array_equal(correct(correction, at).offset_mm, at)
    stopped = correct(correction, beyond)
    assert stopped.is_stopped
    assert np.isnan(stopped.offset_mm).all()
    cut = correct(Correction(y=AxisCorrection(limit_mm=2.0)), beyond)
    np.testing.assert_array_equal(cut.offset_mm, at)
    assert cut.is_limited


def test_half_a_millimetre_off_the_root() -> None:
    correction = Correction(y=AxisCorrection(gain=0.8, bias_mm=0.5), z=AxisCorrection(bias_mm=-0.1))
    np.testing.assert_allclose(correct(correction, (1.0, 0.3)).offset_mm, [1.3, 0.2])


def test_a_height_that_is_drawn_is_followed_whole_and_counts_towards_the_limit() -> None:
    correction = Correction(z=AxisCorrection(gain=0.5, limit_mm=6.0))
    np.testing.assert_allclose(correct(correction, (0.0, 1.0), 4.0).offset_mm, [0.0, 4.5])
    np.testing.assert_allclose(correct(correction, (0.0, 1.0), 8.0).offset_mm, [0.0, 6.0])


def test_a_seam_that_is_not_known_has_no_correction() -> None:
    corrected = correct(Correction(y=AxisCorrection(limit_mm=1.0, at_limit="stop")), (math.nan, math.nan))
    assert np.isnan(corrected.offset_mm).all()
    assert not corrected.is_stopped


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"gain": 0.0}, "gain = 0.0: must be > 0 and at most 1"),
        ({"gain": 1.5}, "gain = 1.5"),
        ({"gain": math.nan}, "gain = nan"),
        ({"limit_mm": 0.0}, "limit_mm = 0.0: must be > 0"),
        ({"bias_mm": math.inf}, "bias_mm = inf: must be finite"),
        ({"bias_mm": -2.0, "limit_mm": 1.0}, "bias_mm = -2.0: is beyond limit_mm = 1.0"),
    ],
)
def test_an_axis_that_cannot_be(wrong: dict[str, float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        AxisCorrection(**wrong)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"extrapolate_mm": -1.0}, r"\[follow\] extrapolate_mm = -1.0: must be >= 0"),
        ({"extrapolate_sigma_mm": 0.0}, r"\[follow\] extrapolate_sigma_mm = 0.0: must be > 0"),
        ({"ends_mm": math.inf}, r"\[follow\] ends_mm = inf: must be >= 0 and finite"),
    ],
)
def test_a_correction_that_cannot_be(wrong: dict[str, float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Correction(**wrong)
