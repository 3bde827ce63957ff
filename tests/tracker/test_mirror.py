"""Stripes that faces mirror in each other: how they move centres, and a seam in spite of them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from noise_model.compiled.arrays import Float64
from tracker.joint.mirror import mirror_pulls_px
from tracker.profile import Section, points_of
from tracker.state import DY_MM, DZ_MM, Frame, Pose
from tracker.tracker import Tracker

CORNERS = np.array([(-60.0, 5.0), (-4.5, 5.0), (-0.5, 0.0), (0.5, 0.0), (3.5, 5.0), (60.0, 5.0)])
CAMERA, LASER = np.array([-70.0, 9.0, 100.0]), np.array([2.0, -4.0, 140.0])
SHEET_SIGMA, PX, PSF_PX, SHARE = 0.25, 1.0 / 2000.0, 0.7, 0.01
NORMAL = np.array([0.998, -0.03, 0.05]) / np.linalg.norm([0.998, -0.03, 0.05])
PLACES = np.array([-4.2, -3.4, -2.5, -1.6, -1.1, -0.8, 0.1, 0.8, 1.2, 1.7, 2.3, 2.9, 3.3])


def face_of(y: float) -> int:
    return int(np.clip(np.searchsorted(CORNERS[:, 0], y) - 1, 0, 4))


def ends(face: int) -> tuple[Float64, Float64, Float64]:
    """A face's first end, the way to its other end and its unit normal (y, z)."""
    first, way = CORNERS[face], CORNERS[face + 1] - CORNERS[face]
    return first, way, np.array([-way[1], way[0]]) / np.linalg.norm(way)


def met(origin: Float64, way: Float64, face: int) -> Float64 | None:
    """The point (3,) of a face that a ray meets from its front."""
    first, along, normal = ends(face)
    towards = way[1:] @ normal
    t = (first - origin[1:]) @ normal / towards if towards < 0.0 else -1.0
    there = origin + t * way
    share = (there[1:] - first) @ along / (along @ along)
    return there if t > 1e-9 and 0.0 <= share <= 1.0 else None


def mirrored(way: Float64, face: int) -> Float64:
    normal = np.array([0.0, *ends(face)[2]])
    return way - 2.0 * (way @ normal) * normal


def lit(point: Float64) -> float:
    return math.exp(-0.5 * ((point - LASER) @ NORMAL / SHEET_SIGMA) ** 2)


def image_light(P: Float64, own: int, mirror: int) -> float:
    """The light that a mirror throws onto a point of a face: of the laser's ray that gets there over it."""
    first, along, normal = ends(mirror)
    above, lamp = (P[1:] - first) @ normal, (LASER[1:] - first) @ normal
    if above <= 0.0 or lamp <= 0.0:
        return 0.0
    # Light takes the shortest way over a mirror: where that meets it divides the two distances.
    foot_p, foot_l = P - above * np.array([0.0, *normal]), LASER - lamp * np.array([0.0, *normal])
    Q = (foot_p * lamp + foot_l * above) / (above + lamp)
    share = (Q[1:] - first) @ along / (along @ along)
    if not 0.0 <= share <= 1.0 or (Q - P)[1:] @ ends(own)[2] <= 0.0:
        return 0.0
    whole = LASER + (Q - LASER) * (1.0 + np.linalg.norm(P - Q) / np.linalg.norm(Q - LASER))
    return lit(whole)


def pixel_ray(place: Float64, u: float) -> Float64:
    """The camera's ray, `u` px farther in its scan line than the one to a place: lines run along x."""
    way = place - CAMERA
    side = np.cross(way, [0.0, 1.0, 0.0])
    side = np.cross([0.0, 1.0, 0.0], way) if side[0] < 0.0 else side
    return way + u * PX * np.linalg.norm(way) * side / np.linalg.norm(side)


def in_sheet(ray: Float64) -> Float64:
    return CAMERA + ((LASER - CAMERA) @ NORMAL) / (ray @ NORMAL) * ray


def traced_pull_px(place: Float64, own: int) -> float:
    """How far light traced over all faces moves a bell that is fitted to a scan line, px, over its share."""
    fine = np.arange(-16.0, 16.0, 0.1)
    stripe, image = np.zeros(len(fine)), np.zeros(len(fine))
    first, _, normal = ends(own)
    for i, u in enumerate(fine):
        ray = pixel_ray(place, u)
        P = CAMERA + ((first - CAMERA[1:]) @ normal) / (ray[1:] @ normal) * ray
        stripe[i] = lit(P)
        for face in range(len(CORNERS) - 1):
            if face != own:
                seen = met(P, mirrored(ray, own), face)
                image[i] += (0.0 if seen is None else lit(seen)) + image_light(P, own, face)
    blur = np.exp(-0.5 * (np.arange(-4.0, 4.05, 0.1) / PSF_PX) ** 2)
    stripe, image = np.convolve(stripe, blur, "same"), np.convolve(image, blur, "same")

    def centre(light: Float64) -> float:
        def off(p: Float64) -> Float64:
            return np.asarray(p[0] * np.exp(-0.5 * ((fine - p[1]) / p[2]) ** 2) - light)

        return float(least_squares(off, (stripe.max(), 0.0, 2.0), xtol=1e-12, ftol=1e-12).x[1])

    return (centre(stripe + SHARE * image) - centre(stripe)) / SHARE


def test_mirrored_stripes_move_centres_as_light_that_is_traced_over_the_faces() -> None:
    heights = np.interp(PLACES, CORNERS[:, 0], CORNERS[:, 1])
    x = LASER[0] - (NORMAL[1] * (PLACES - LASER[1]) + NORMAL[2] * (heights - LASER[2])) / NORMAL[0]
    places = np.column_stack([x, PLACES, heights])
    moves = np.array([in_sheet(pixel_ray(place, 1.0)) - place for place in places])
    n = np.ones(len(PLACES))
    points = points_of(PLACES, heights, scan=np.arange(len(n)), sigma_px=n, beside_px=n)
    points[DY_MM], points[DZ_MM] = moves[:, 1], moves[:, 2]
    section = Section(points, 0.1, camera_mm=CAMERA, laser_mm=LASER, sheet=np.array([*NORMAL, SHEET_SIGMA]))
    section = section._replace(light=section.light._replace(psf_sigma_px=PSF_PX))
    pulls_px = mirror_pulls_px(section, CORNERS, 0.0).sum(axis=0)
    traced_px = [traced_pull_px(place, face_of(place[1])) for place in places]
    np.testing.assert_allclose(pulls_px, traced_px, rtol=0.03, atol=0.03)
    assert np.abs(traced_px).max() > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("mirrored", [0.0, 0.15, 0.3])
def test_a_groove_whose_faces_mirror_the_stripe_is_within_its_sigma(
    mirrored: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another renderer than the forward model draws three Vs from behind and from the side."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    scenes, world, light, welding = (
        __import__(name) for name in ("random_scene", "swept_world", "swept_light", "swept_welding")
    )
    pulls, sigmas_mm = [], []
    for seed in (55, 99, 110):
        scene = scenes.draw_scene(seed, 1, "on")
        setup = replace(scene.setup, arc=replace(scene.setup.arc, radiance_e=0.0))
        around = light.Surroundings(welding=welding.Welding(mirrored=mirrored))
        swept = world.SweptWorld(setup, scene.world, world.Speckle(0.0, 1.0), around)
        image = swept.frame(scene.poses[0], True, True, np.random.default_rng(seed))
        frame = Frame(0, 0.0, image, setup.camera.exposure_s, math.nan, True, False)
        track = Tracker(setup).step(frame, Pose(scene.poses[0]))
        assert track.valid
        error_mm = np.subtract(track.seam_tool_mm, scene.world.seam_tool_mm(setup, scene.poses[0]))[1:]
        sigmas_mm.append((track.sigma_y_mm, track.sigma_z_mm))
        pulls.append(error_mm / sigmas_mm[-1])
    assert np.abs(pulls).max() < 3.5
    assert np.sqrt(np.mean(np.square(pulls))) < 1.6
    assert np.max(sigmas_mm) < 0.1
