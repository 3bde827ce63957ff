"""Chords of the arc's disc, many at a time, against the same case by case."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from noise_model.arc.chords import MAX_PIECES, Shape, chords


def near_equator(p: float, arc: Shape) -> float | None:
    """Return q of the equator's near arc on the chord at p; None where the chord does not cross it."""
    sin_b, _, tan_b, cos_e, wz = arc
    # R sin(psi) = p tan(beta) (d - R cos(psi) cos(e)) as a sine shifted by a phase, d = 1 and R = sin(beta).
    size = math.hypot(sin_b, p * tan_b * sin_b * cos_e)
    if abs(p * tan_b) > size:
        return None
    phase = math.atan2(p * tan_b * cos_e, 1.0)
    psi = math.asin(p * tan_b / size) - phase
    cos_psi = math.cos(psi)
    if cos_psi * cos_e < sin_b - 1e-12:
        return None
    return sin_b * cos_psi * wz / ((1.0 - sin_b * cos_psi * cos_e) * tan_b)


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(
    distance=st.floats(1.05, 20.0),
    elevation=st.floats(-1.4, 1.4),
    below=st.booleans(),
    lines=st.lists(st.tuples(st.floats(-0.95, 0.95), st.floats(0.0, 6.2)), max_size=3),
)
def test_chords_are_open_between_outline_equator_and_lines(distance, elevation, below, lines):
    sin_b = 1.0 / distance
    cos_b = math.sqrt(1.0 - sin_b**2)
    arc = (sin_b, cos_b, sin_b / cos_b, math.cos(elevation), math.sin(elevation))
    cuts = np.array([[a, math.cos(turn), math.sin(turn)] for a, turn in lines]).reshape(-1, 3)
    at = np.full((3, MAX_PIECES), math.nan)
    n = 41
    at[0, :n] = np.linspace(-1.0, 1.0, n)
    chords(at, 0, n, arc, below, cuts, len(cuts))
    for p, low, high in at[:, :n].T:
        top = math.sqrt(1.0 - p * p)
        equator = near_equator(p, arc)
        bottom = (top if below else -top) if equator is None else max(-top, equator)
        for a, b, c in cuts:
            if c > 1e-12:
                bottom = max(bottom, -(a + b * p) / c)
            elif c < -1e-12:
                top = min(top, -(a + b * p) / c)
            elif a + b * p <= 0.0:
                top = bottom
        # At the rim, p = 1, a rounding by 1e-16 stands under a root.
        rounding = 1e-9 if abs(p) < 1.0 else 3e-8
        assert (low, high) == (
            pytest.approx(bottom, rel=1e-12, abs=rounding),
            pytest.approx(top, abs=rounding),
        )
    assert np.isnan(at[:, n:]).all()
