"""The arc map against Mitsuba 3, a path tracer that is not ours, where that is installed."""

import dataclasses
import math
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arctrack.nominal import looking_at
from noise_model.arc.map import arc_at, arc_frame, arc_kernel
from noise_model.arc.scene import make_scene
from noise_model.instrument.camera import Rays
from noise_model.surface.brdf import TABLE_1, Lobe, Material
from noise_model.surface.joint import Joint
from tests.validation import worlds
from validation.figures.hemisphere import Hemisphere, irradiance_extended
from validation.second_renderer.blocks import BLOCK_PX, compare_blocks
from validation.second_renderer.joint_mesh import REACH_MM, joint_mesh
from validation.second_renderer.path_traced import load_mitsuba, path_traced_arc

RADIANCE_E = {"mild_steel": 2.0e8, "zn_coated": 8.0e6}
"""Some 10^4 electrons a pixel, as a user would set the aperture."""

POSES = {
    "arc on the left": ((5.0, 3.0, 1.0), (2.0, -3.0, 6.0)),
    "arc on the right": ((8.0, -3.5, 2.0), (-3.0, 4.0, -8.0)),
}
"""Shift, mm, and turn, deg; of a lap the arc is once in front of the edge and once behind it."""

STRIP_EVERY = 12
"""One row of blocks in so many is compared: Mitsuba needs minutes for a whole frame."""


def setup_of(joint, material="zn_coated", width=640):
    return worlds.setup_of(joint, material, width, RADIANCE_E.get(material, 1.0e7))


def arc_pixels(setup, T_base_tool, **nodes):
    rays = Rays.of(setup.camera)
    kernel = arc_kernel(setup, make_scene(setup, T_base_tool), **nodes)
    pixels = np.arange(rays.cos4.size)
    mean_e, _ = arc_at(kernel, rays.xy.reshape(-1, 2), rays.cos4.reshape(-1), pixels)
    return mean_e.reshape(rays.cos4.shape)


@pytest.mark.parametrize("material", TABLE_1)
@pytest.mark.parametrize("joint_type", ["flat", "v_groove", "lap", "corrugation"])
def test_the_arc_map_is_the_path_tracers(mitsuba, joint_type, material):
    setup = setup_of(joint_type, material)
    rays = Rays.of(setup.camera)
    rows = np.arange(setup.camera.height) // BLOCK_PX
    strips = (rows % STRIP_EVERY == 0) & (rows < setup.camera.height // BLOCK_PX)
    predicted, traced, sigma = [], [], []
    for seed, place in enumerate(POSES.values()):
        T_base_tool = worlds.pose(*place)
        kernel = arc_kernel(setup, make_scene(setup, T_base_tool))
        frame_e = arc_frame(kernel, rays.xy.reshape(-1, 2), rays.cos4.reshape(-1), rays.cos4.shape)
        mean_e, sigma_e = path_traced_arc(setup, T_base_tool, samples=256, seed=seed, xy=rays.xy[strips])
        predicted.append(frame_e[strips])
        traced.append(mean_e)
        sigma.append(sigma_e)
    agreement = compare_blocks(np.concatenate(predicted), np.concatenate(traced), np.concatenate(sigma))
    assert agreement.n_blocks > 500
    assert abs(agreement.median_ratio - 1.0) < 0.005, agreement
    assert agreement.within >= 0.95, agreement


def test_lit_by_the_bare_dome_a_lambertian_plate_shows_the_closed_forms(mitsuba):
    setup = setup_of("flat", width=32)
    setup = dataclasses.replace(setup, material=Material("lambert", 0.3, 0.0, 1.0))
    T_base_tool = worlds.pose((7.0, -2.0, 0.0), (0.0, 0.0, 0.0))
    mean_e, sigma_e = path_traced_arc(setup, T_base_tool, samples=4096)
    rays = Rays.of(setup.camera)
    T_base_camera = T_base_tool @ setup.camera.T_tool_camera
    d = np.concatenate([rays.xy, np.ones((*rays.cos4.shape, 1))], axis=-1) @ T_base_camera[:3, :3].T
    points = T_base_camera[:3, 3] - T_base_camera[2, 3] / d[..., 2:] * d
    up = np.array([0.0, 0.0, 1.0])
    arc = Hemisphere(np.array([7.0, -2.0, 0.0]), setup.arc.radius_mm, up)
    E = irradiance_extended(points.reshape(-1, 3), np.broadcast_to(up, (points[..., 0].size, 3)), arc)
    want = setup.arc.radiance_e * 0.3 * E.reshape(rays.cos4.shape) * rays.cos4
    assert np.abs(mean_e / want - 1.0).max() < 0.02
    assert abs(np.median(mean_e / want) - 1.0) < 0.001
    assert 0.8 < np.std((mean_e - want) / sigma_e) < 1.4


def test_the_arc_itself_hides_nothing(mitsuba):
    setup = setup_of("flat", width=64)
    low = dataclasses.replace(setup.camera, T_tool_camera=looking_at((-70.0, 0.0, 25.0), (8.0, 0.0, 0.0)))
    setup = dataclasses.replace(setup, camera=low)
    mean_e, _ = path_traced_arc(setup, np.eye(4), samples=1024)
    # Beside the arc the map's usual nodes are too few.
    want = arc_pixels(setup, np.eye(4), nodes=(64, 64))
    ray = np.concatenate([Rays.of(low).xy, np.ones((48, 64, 1))], axis=-1) @ low.T_tool_camera[:3, :3].T
    eye = low.T_tool_camera[:3, 3]
    nearest = np.linalg.norm(np.cross(ray, eye), axis=-1) / np.linalg.norm(ray, axis=-1)
    passes = -(ray @ eye) / np.sum(ray**2, axis=-1) < -eye[2] / ray[..., 2]
    behind = passes & (nearest < 0.8 * setup.arc.radius_mm) & (want > 0.0)
    assert behind.sum() > 30
    assert abs(np.median(mean_e[behind] / want[behind]) - 1.0) < 0.005


@pytest.mark.parametrize("lobe", [Lobe(tail=0.7), Lobe(anisotropy=0.5, marks_deg=25.0)])
def test_a_lobe_of_another_shape_is_traced_too(mitsuba, lobe):
    setup = setup_of("v_groove", "mild_steel", width=128)
    plain = dataclasses.replace(setup, material=Material("plain", 0.002, 0.5, 20.0))
    shaped = dataclasses.replace(setup, material=Material("shaped", 0.002, 0.5, 20.0, lobe))
    T_base_tool = worlds.pose(*POSES["arc on the left"])
    traced = path_traced_arc(shaped, T_base_tool, samples=400)
    assert compare_blocks(arc_pixels(shaped, T_base_tool), *traced).within >= 0.95
    assert compare_blocks(arc_pixels(plain, T_base_tool), *traced).within < 0.7


def test_a_seed_repeats_and_sigma_is_the_scatter_between_seeds(mitsuba):
    setup = setup_of("lap", width=64)
    T_base_tool = worlds.pose(*POSES["arc on the right"])
    first, again, other = (path_traced_arc(setup, T_base_tool, samples=256, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    lit = first[0] > 100.0
    z = (first[0] - other[0])[lit] / np.hypot(first[1], other[1])[lit]
    assert 0.9 < np.std(z) < 1.2


def test_no_paths_is_refused():
    with pytest.raises(ValueError, match="samples = 0"):
        path_traced_arc(setup_of("flat", width=32), np.eye(4), samples=0)


def test_without_mitsuba_the_cure_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(ImportError, match=r"pip install 'arctrack\[reference\]'"):
        load_mitsuba()


sizes = st.floats(0.5, 10.0)
JOINTS = st.one_of(
    st.just(("flat", {})),
    st.tuples(
        st.just("v_groove"),
        st.fixed_dictionaries(
            {
                "included_angle_deg": st.floats(20.0, 120.0),
                "depth_mm": sizes,
                "root_gap_mm": st.one_of(st.just(0.0), sizes),
            }
        ),
    ),
    st.tuples(st.just("lap"), st.fixed_dictionaries({"thickness_mm": sizes})),
    st.just(("corrugation", {"thickness_mm": 1.6, "pitch_mm": 60.0, "height_mm": 8.0, "width_mm": 30.0})),
)


def height(joint_type, size, x, y):
    """RECORDING.md's cross-sections, mm."""
    if joint_type == "flat":
        return np.zeros_like(y)
    if joint_type == "v_groove":
        run = (np.abs(y) - size["root_gap_mm"] / 2.0) / math.tan(math.radians(size["included_angle_deg"] / 2))
        return np.minimum(np.maximum(run, 0.0) - size["depth_mm"], 0.0)
    step = np.where(y < 0.0, size["thickness_mm"], 0.0)
    if joint_type == "lap":
        return step
    u = x - size["pitch_mm"] * np.rint(x / size["pitch_mm"])
    wave = size["height_mm"] / 2.0 * (1.0 + np.cos(2.0 * np.pi * u / size["width_mm"]))
    return step + np.where(np.abs(u) < size["width_mm"] / 2.0, wave, 0.0)


@pytest.mark.slow
@given(JOINTS, st.floats(-50.0, 50.0))
@settings(max_examples=30, deadline=None)
def test_the_mesh_is_the_joint_of_recording_md(joint, middle_x_mm):
    joint_type, size = joint
    faces = joint_mesh(Joint(joint_type, size, ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))), middle_x_mm)
    rng = np.random.default_rng(0)
    covered_mm2 = 0.0
    for face in faces:
        corners = face.vertices_mm[face.triangles]
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat = area / np.linalg.norm(area, axis=1, keepdims=True)
        # The normals stand on the triangles, and out of the metal: up, or towards the lower sheet.
        assert (np.sum(flat[:, np.newaxis] * face.normals[face.triangles], axis=-1) > 1.0 - 1e-4).all()
        np.testing.assert_allclose(np.linalg.norm(face.normals, axis=1), 1.0)
        if np.abs(area[:, 2]).max() < 1e-9:
            np.testing.assert_allclose(face.normals, np.broadcast_to([0.0, 1.0, 0.0], face.normals.shape))
            np.testing.assert_array_equal(face.vertices_mm[:, 1], 0.0)
            continue
        assert (face.normals[:, 2] > 0.0).all()
        covered_mm2 += 0.5 * area[:, 2].sum()
        inside = rng.dirichlet([1.0, 1.0, 1.0], len(corners))
        x, y, z = np.einsum("ij,ijk->ki", inside, corners)
        np.testing.assert_allclose(z, height(joint_type, size, x, y), atol=2e-5)
    assert covered_mm2 == pytest.approx((2.0 * REACH_MM) ** 2)


def test_blocks_that_are_off_are_counted_and_dark_ones_are_not():
    reference = np.full((18, 27), 1000.0)
    reference[9:] = 0.0
    sigma = np.full(reference.shape, 9.0)
    sigma[9:] = 0.0
    predicted = 1.001 * reference
    predicted[:9, 9:18] = 1042.0
    predicted[:9, 18:] = 1032.0
    agreement = compare_blocks(predicted, reference, sigma)
    # A block's mean has a standard error of 9 e / 9: 42 e off are 39 beyond three of them, 32 are 29.
    assert agreement.n_blocks == 3
    assert agreement.within == pytest.approx(2.0 / 3.0)
    assert agreement.worst == pytest.approx(0.039)
    assert agreement.median_ratio == pytest.approx(1.032)


def test_a_pixel_that_one_image_alone_knows_spoils_its_block():
    reference = np.full((9, 18), 1000.0)
    predicted = reference.copy()
    predicted[3, 3] = reference[3, 12] = np.nan
    predicted[3, 12] = np.nan
    agreement = compare_blocks(predicted, reference, np.zeros(reference.shape))
    assert agreement.within == 0.5
    assert agreement.worst == np.inf


def test_darkness_all_over_is_refused():
    with pytest.raises(ValueError, match="every block is dark"):
        compare_blocks(np.zeros((9, 9)), np.zeros((9, 9)), np.zeros((9, 9)))
