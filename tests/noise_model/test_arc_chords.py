"""Chords of the arc's disc and the rays along them, many at a time, against the same one by one."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from noise_model.arc_disc import MAX_PIECES, chords, disc, equator_q
from noise_model.arc_metal import MAX_WAYS, clearance, clearances

UNIT = st.floats(-1.0, 1.0)


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
    chords(at, n, arc, below, cuts, len(cuts))
    for p, low, high in at[:, :n].T:
        top = math.sqrt(1.0 - p * p)
        bottom = max(-top, equator_q(p, arc, top if below else -top))
        for a, b, c in cuts:
            if c > 1e-12:
                bottom = max(bottom, -(a + b * p) / c)
            elif c < -1e-12:
                top = min(top, -(a + b * p) / c)
            elif a + b * p <= 0.0:
                top = bottom
        assert (low, high) == (pytest.approx(bottom, abs=1e-9), pytest.approx(top, abs=1e-9))
    assert np.isnan(at[:, n:]).all()


@settings(max_examples=300, deadline=None)
@given(
    way=st.tuples(st.floats(-30.0, 30.0), st.floats(-8.0, 8.0), st.floats(0.5, 6.0)),
    over=st.floats(-4.0, 4.0),
    slope=st.sampled_from([0.0, 0.1]),
    curve=st.sampled_from([0.0, 0.004, -0.004]),
    crest=UNIT,
    flags=st.tuples(st.booleans(), st.booleans(), st.booleans()),
)
def test_rays_pass_over_the_metal_by_as_much_as_one_by_one(way, over, slope, curve, crest, flags):
    P, center, radius = (3.0, over, 1.0), (3.0 + way[0], over + way[1], 1.0 + way[2]), 3.0
    distance = math.dist(P, center)
    if distance <= 1.01 * radius:
        return
    _, (wx, wy, wz, ux, uy, vx, vy, vz), arc = disc(P, center, radius)
    tan_b = arc[2]
    along = tan_b * ux, tan_b * uy, 0.0, tan_b * vx, tan_b * vy, tan_b * vz
    rays = (*P, wx, wy, wz, *along, distance, radius)
    metal = (2.0, 10.0, 20.0, (0.0, slope, curve, 1.5), P[0] + crest * way[0], *flags)
    ways = np.zeros((3, MAX_WAYS))
    p, q = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.95, 0.95, 9), np.linspace(-0.95, 0.95, 9)))
    ways[0, : len(p)], ways[1, : len(p)] = p, q
    clearances(ways, len(p), rays, metal)
    want = [clearance(*of, rays, metal) for of in zip(p, q, strict=True)]
    np.testing.assert_allclose(ways[2, : len(p)], want, rtol=1e-9, atol=1e-9)
