"""Chords of the arc's disc and the rays along them, many at a time, against the same case by case."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from noise_model.arc.chords import MAX_PIECES, Shape, chords, disc
from noise_model.arc.clearance import Metal, Rays, clearances, ways_room
from noise_model.arc.sheet_occlusion import MAX_WAYS
from noise_model.surface.faces import raised
from noise_model.surface.visibility import first_crossing

UNIT = st.floats(-1.0, 1.0)


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


def ray_clearance(p: float, q: float, rays: Rays, metal: Metal) -> float:
    """Return by how much the ray to the arc's point at (p, q) passes over the metal, mm, case by case."""
    P, w, u, v = (np.array(rays[i : i + 3]) for i in (0, 3, 6, 9))
    distance, radius = rays[12:]
    depth, width, pitch, edge, crest_x, edge_hides, cuts, from_upper = metal
    edge_y, slope, curve, edge_step = edge

    def height(x: float) -> float:
        return float(raised(x, depth, width, pitch)[0])

    o = w + p * u + q * v
    across, bend = o[1] - slope * o[0], curve * o[0] ** 2
    if not cuts and not from_upper and across >= 0.0 and curve <= 0.0:
        return 1e9
    # The nearer point of the ray t o on the sphere about `distance` w.
    t_arc = min(np.roots([o @ o, -2.0 * distance * (o @ w), distance**2 - radius**2]).real)
    free = 1e9
    if cuts:
        x, y, z = P + t_arc * o
        lower = y - edge_y - slope * (x - P[0]) - 0.5 * curve * (x - P[0]) ** 2 < 0.0
        free = z - height(x) - (edge_step if lower else 0.0)
    if edge_hides:
        t = first_crossing(P[1] - edge_y, across, bend, from_upper)
        first, last = (0.0, min(t, t_arc)) if from_upper else (t, t_arc)
        if t < t_arc and (t > 0.0 or not from_upper):
            free = min(free, P[2] + t * o[2] - height(P[0] + t * o[0]) - edge_step)
        if o[0] != 0.0 and first < (crest_x - P[0]) / o[0] < last:
            at = (crest_x - P[0]) / o[0]
            free = min(free, P[2] + at * o[2] - height(crest_x) - edge_step)
    return free


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
        assert (low, high) == (pytest.approx(bottom, rel=1e-12, abs=1e-9), pytest.approx(top, abs=1e-9))
    assert np.isnan(at[:, n:]).all()


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(
    way=st.tuples(st.floats(-30.0, 30.0), st.floats(-8.0, 8.0), st.floats(0.5, 6.0)),
    over=st.floats(-4.0, 4.0),
    slope=st.sampled_from([0.0, 0.1]),
    curve=st.sampled_from([0.0, 0.004, -0.004]),
    crest=UNIT,
    flags=st.tuples(st.booleans(), st.booleans(), st.booleans()),
)
def test_rays_pass_over_the_metal_by_as_much_as_case_by_case(way, over, slope, curve, crest, flags):
    P, center, radius = (3.0, over, 1.0), (3.0 + way[0], over + way[1], 1.0 + way[2]), 3.0
    distance = math.dist(P, center)
    if distance <= 1.01 * radius:
        return
    _, (wx, wy, wz, ux, uy, vx, vy, vz), arc = disc(P, center, radius)
    tan_b = arc[2]
    along = tan_b * ux, tan_b * uy, 0.0, tan_b * vx, tan_b * vy, tan_b * vz
    rays = (*P, wx, wy, wz, *along, distance, radius)
    metal = (2.0, 10.0, 20.0, (0.0, slope, curve, 1.5), P[0] + crest * way[0], *flags)
    ways, _ = ways_room(MAX_WAYS)
    p, q = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.95, 0.95, 9), np.linspace(-0.95, 0.95, 9)))
    ways.p[: len(p)], ways.q[: len(p)] = p, q
    clearances(ways.p, ways.q, ways.free, len(p), rays, metal)
    want = [ray_clearance(x, y, rays, metal) for x, y in zip(p, q, strict=True)]
    np.testing.assert_allclose(ways.free[: len(p)], want, rtol=1e-9, atol=1e-9)
