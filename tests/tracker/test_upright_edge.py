"""Where points change from one face to another: the edge's place, and an honest sigma of it."""

from __future__ import annotations

import numpy as np
import pytest
from edge_twins import FacesBeside, moved_by_background_px
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import Profile
from stripe_ends import DEPTH, EDGE, N_SCAN, WIDTH_PX, light_of, profile_of

from noise_model.compiled.arrays import Float64
from tracker.joint.measured import meet_face
from tracker.joint.upright_edge import (
    Edge,
    Faces,
    HiddenStrip,
    change_of,
    edge_between,
    points_around_edge,
    upright_edge,
)
from tracker.stripe.light import NO_LIGHT, background_off_px

COLUMN_MM, NEAR_MM = 0.1, 2.0


def sheets(rng: np.random.Generator, edge_mm: float, step_mm: float, sigma_mm: float) -> Profile:
    """Points of two flat sheets whose heights scatter: the upper one lies before the edge."""
    y_mm = COLUMN_MM * np.arange(-40, 41) + rng.uniform(0.0, COLUMN_MM)
    n = len(y_mm)
    z_mm = np.where(y_mm < edge_mm, step_mm, 0.0) + sigma_mm * rng.standard_normal(n)
    scan, dz_mm = np.arange(n, dtype=float), np.full(n, 0.1)
    sigma_px = np.full(n, sigma_mm / 0.1)
    return Profile(y_mm, z_mm, np.zeros(n), dz_mm, sigma_px, scan, COLUMN_MM, sigma_px, light=NO_LIGHT)


def flat_faces(n: int, step_mm: float) -> Faces:
    return Faces(np.full(n, step_mm), np.zeros(n), np.zeros(n), np.zeros(n))


def edge_of(profile: Profile, faces: Faces, limits_mm: Float64, is_profile: bool) -> Edge | None:
    points = profile.points
    before, behind = points_around_edge(points, faces, limits_mm)
    if before < 0:
        return None
    light, strip = (NO_LIGHT if profile.light is None else profile.light), HiddenStrip(0.0, 0.0, 0.0)
    edge: Edge = edge_between(
        points, faces, limits_mm, 1e-3, COLUMN_MM, light, before, behind, strip, is_profile
    )
    return edge


@pytest.mark.parametrize("is_profile", [False, True])
@pytest.mark.parametrize(("step_sigmas", "as_if_sure"), [(1.5, 3.0), (2.5, 1.8), (4.0, 0.8), (50.0, 0.8)])
def test_an_edge_is_as_unsure_as_its_points(step_sigmas: float, as_if_sure: float, is_profile: bool) -> None:
    rng, step_mm, pulls, scaled = np.random.default_rng(3), 1.0, [], []
    for _ in range(400):
        edge_mm = float(rng.uniform(-0.9 * NEAR_MM, 0.9 * NEAR_MM))
        profile = sheets(rng, edge_mm, step_mm, step_mm / step_sigmas)
        limits_mm = np.where(np.abs(profile.y_mm) < NEAR_MM, 0.5 * step_mm, 0.0)
        edge = edge_of(profile, flat_faces(len(limits_mm), step_mm), limits_mm, is_profile)
        if edge is not None:
            pulls.append((edge.y_mm - edge_mm) / np.sqrt(edge.variance_mm2))
            scaled.append((edge.y_mm - edge_mm) * np.sqrt(12.0) / COLUMN_MM)
    assert len(pulls) > 300
    assert 0.8 < np.sqrt(np.mean(np.square(pulls))) < 1.25
    # By the sigma of an edge that lies between its two neighbours for sure, it is off by so much.
    assert np.sqrt(np.mean(np.square(scaled))) > as_if_sure


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_a_change_is_its_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    light = light_of(rng, EDGE + 0.3, EDGE + rng.uniform(0.0, 2.0))
    light.background_e[:] += rng.normal(0.0, 300.0, light.background_e.shape)
    n = N_SCAN
    heights_mm, slopes = rng.normal(0.0, 0.05, (2, n)), rng.normal(0.0, 0.2, (2, n))
    heights_mm[0] += 1.0
    straight = profile_of(light)
    profile = Profile(
        straight.y_mm,
        np.where(straight.y_mm < 0.0, 1.0, 0.0) + rng.normal(0.0, 0.4, n),
        rng.normal(0.0, 0.02, n),
        straight.dz_mm,
        rng.uniform(1.0, 4.0, n),
        straight.scan,
        straight.column_mm,
        straight.beside_px,
        light=light,
    )
    near = np.abs(profile.y_mm) < 1.5
    faces = Faces(heights_mm[0], slopes[0], heights_mm[1], slopes[1])
    before, behind = points_around_edge(profile.points, faces, np.where(near, 0.5, 0.0))
    if before < 0:
        return
    limits_mm = np.where(near, 0.5, 0.0)
    points, column_mm, strip = profile.points, profile.column_mm, HiddenStrip(0.1, 0.02, 0.0)
    on_before = meet_face(points, faces.before_mm, faces.before_slope)
    on_behind = meet_face(points, faces.behind_mm, faces.behind_slope)
    found = change_of(
        points,
        faces,
        limits_mm,
        0.02,
        column_mm,
        light,
        before,
        behind,
        on_before.y_mm,
        on_behind.y_mm,
    )
    twin = FacesBeside(heights_mm, slopes)
    change, met = twin.change(profile, near, 0.02, before, behind), twin.met(profile, before)
    np.testing.assert_allclose(found, change, rtol=1e-4, atol=1e-9)
    edge = edge_between(points, faces, limits_mm, 0.02, column_mm, light, before, behind, strip, False)
    expected = upright_edge(profile.scan, column_mm, light, before, behind, strip, met, change)
    np.testing.assert_allclose(edge, expected, rtol=1e-4, atol=1e-9)


def test_a_centre_moves_with_its_background() -> None:
    """Where the background is the next line's, a weightless fit of the stripe's centre moves by so much."""
    light = light_of(np.random.default_rng(1), N_SCAN + 9.0, N_SCAN + 9.0, noise=False)
    ramp = np.linspace(-1.0, 1.0, DEPTH) * 400.0
    light.background_e[EDGE + 1 :] += ramp.astype(np.float32)
    scan = np.arange(EDGE - 8.0, EDGE + 9.0)
    sigma_px = np.full(len(scan), 0.05)
    moved_px = background_off_px(light, scan, sigma_px)
    twin_px = moved_by_background_px(light, scan, sigma_px)
    np.testing.assert_allclose(moved_px, twin_px, rtol=1e-3, atol=1e-6)
    # With g e- a pixel, sum d t is g w sqrt(2 pi), and A sum t^2 is A sqrt(pi) / (2 w).
    slope_e, amplitude_e = 800.0 / (DEPTH - 1), 3000.0
    whole_px = slope_e * np.sqrt(2.0 * np.pi) * WIDTH_PX * 2.0 * WIDTH_PX / (amplitude_e * np.sqrt(np.pi))
    beside = (scan == EDGE) | (scan == EDGE + 1)
    np.testing.assert_allclose(moved_px[beside], 0.5 * whole_px, rtol=0.05)
    np.testing.assert_array_equal(moved_px[~beside], 0.0)
    assert (background_off_px(light, scan, 100.0 * moved_px.max() + sigma_px) == 0.0).all()
    assert (background_off_px(NO_LIGHT, scan, sigma_px) == 0.0).all()
