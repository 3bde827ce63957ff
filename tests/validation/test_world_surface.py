"""The true joint against RECORDING.md's cross-sections, by heights alone."""

import math

import numpy as np
import pytest

from noise_model.surface.joint import Joint
from validation.second_renderer.world_surface import Departure, OnePlateTilted, TrueSurface

SEAM = ((-90.0, 0.0, 0.0), (230.0, 0.0, 0.0))
JOINTS = {
    "flat": {},
    "v_groove": {"included_angle_deg": 70.0, "depth_mm": 4.0, "root_gap_mm": 1.0},
    "lap": {"thickness_mm": 2.0},
    "corrugation": {"thickness_mm": 1.5, "pitch_mm": 60.0, "height_mm": 8.0, "width_mm": 30.0},
    "butt": {"gap_mm": 1.0, "thickness_mm": 3.0},
    "fillet": {"included_angle_deg": 80.0},
    "outside_corner": {"included_angle_deg": 100.0},
}
DEPARTURE = Departure(0.9, 110.0, 0.01)


def height(joint_type, x, y):
    """RECORDING.md's height over the plane z = 0, the seam moved."""
    size = JOINTS[joint_type]
    y = y - sway(x)
    if joint_type == "corrugation":
        # The sheet lies turned by arctan(0.01) about the joint frame's origin.
        s = np.linspace(-40.0, 80.0, 1_200_001)
        u = s - 60.0 * np.rint(s / 60.0)
        c = np.where(np.abs(u) < 15.0, 4.0 * (1.0 + np.cos(2.0 * np.pi * u / 30.0)), 0.0)
        there, raised = (s - 0.01 * c) / math.hypot(1.0, 0.01), (0.01 * s + c) / math.hypot(1.0, 0.01)
        return np.interp(x, there, raised) + np.where(y < 0.0, size["thickness_mm"], 0.0)
    z = 0.01 * x
    if joint_type == "v_groove":
        run = (np.abs(y) - 0.5) / math.tan(math.radians(35.0))
        return z + np.minimum(np.maximum(run, 0.0) - 4.0, 0.0)
    if joint_type == "lap":
        z = z + np.where(y < 0.0, size["thickness_mm"], 0.0)
    if joint_type == "butt":
        z = z - np.where(np.abs(y) < 0.5, size["thickness_mm"], 0.0)
    if joint_type == "fillet":
        z = z + np.abs(y) / math.tan(math.radians(40.0))
    if joint_type == "outside_corner":
        z = z - np.abs(y) / math.tan(math.radians(50.0))
    return z


def sway(x):
    return 0.9 * np.sin(2.0 * np.pi * x / 110.0)


def outward(joint_type, x, y):
    """The sign of an upright face's normal along y."""
    return -np.sign(y - sway(x)) if joint_type == "butt" else np.ones_like(y)


def surface_of(joint_type, departure=DEPARTURE):
    return TrueSurface(Joint(joint_type, JOINTS[joint_type], SEAM), departure)


@pytest.mark.parametrize("joint_type", JOINTS)
def test_the_mesh_is_the_joint_moved(joint_type):
    vertices, triangles, faces = surface_of(joint_type).mesh(-30.0, 60.0)
    assert len(triangles) == len(faces)
    corners = vertices[triangles]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    weights = np.random.default_rng(1).dirichlet([1.0, 1.0, 1.0], len(corners))
    x, y, z = np.einsum("ij,ijk->ki", weights, corners)
    stands = np.abs(area[:, 2]) < 1e-9
    np.testing.assert_allclose(z[~stands], height(joint_type, x, y)[~stands], atol=1e-3)
    # Out of the metal: up, at a lap's edge towards the lower sheet, and between a butt's into the gap.
    assert (area[~stands, 2] > 0.0).all()
    assert (area[stands, 1] * outward(joint_type, x, y)[stands] > 0.0).all()
    assert stands.any() == (joint_type in ("lap", "corrugation", "butt"))


@pytest.mark.parametrize("joint_type", JOINTS)
def test_hits_settle_on_the_exact_surface_with_its_normals(joint_type):
    surface = surface_of(joint_type)
    draw = np.random.default_rng(2)
    eye = np.array([30.0, 3.0, 120.0])
    vertices, triangles, faces = surface.mesh(-30.0, 60.0)
    some = draw.choice(len(triangles), 300)
    middle = vertices[triangles[some]].mean(axis=1)
    way = middle - eye
    length = np.linalg.norm(way, axis=1)
    points, normals = surface.settle(eye, way / length[:, None], length, faces[some])
    stands = np.abs(normals[:, 2]) < 1e-6
    x, y, z = points[~stands].T
    np.testing.assert_allclose(z, height(joint_type, x, y), atol=1e-6)
    step = 1e-5
    dz_dx = (height(joint_type, x + step, y) - height(joint_type, x - step, y)) / (2.0 * step)
    dz_dy = (height(joint_type, x, y + step) - height(joint_type, x, y - step)) / (2.0 * step)
    want = np.column_stack([-dz_dx, -dz_dy, np.ones(len(x))])
    want /= np.linalg.norm(want, axis=1, keepdims=True)
    np.testing.assert_allclose(normals[~stands], want, atol=1e-5)
    x, y, _ = points[stands].T
    gap = 0.5 if joint_type == "butt" else 0.0
    np.testing.assert_allclose(np.abs(y - sway(x)), gap, atol=1e-6)
    assert (normals[stands, 1] * outward(joint_type, x, y) > 0.99).all()


@pytest.mark.parametrize("joint_type", ["v_groove", "lap", "fillet"])
def test_one_plate_is_turned_about_the_seam(joint_type):
    tilted = OnePlateTilted(*vars(DEPARTURE).values(), roll_deg=2.0, side=-1.0)
    before, after = (surface_of(joint_type, seam).outline_mm() for seam in (DEPARTURE, tilted))
    np.testing.assert_array_equal(before[:, 0], after[:, 0])
    y = before[:, 0]
    np.testing.assert_allclose(after[:, 1] - before[:, 1], math.tan(math.radians(2.0)) * np.minimum(y, 0.0))


@pytest.mark.parametrize(("joint_type", "over"), [("v_groove", -4.0), ("lap", 0.0), ("corrugation", 8.0)])
def test_the_seam_point_is_the_root_or_the_foot(joint_type, over):
    """On a crest the ridge's lean does not show but in second order."""
    x, y, z = surface_of(joint_type).seam_point(60.0)
    assert (x, y) == (60.0, pytest.approx(0.9 * math.sin(2.0 * math.pi * 60.0 / 110.0)))
    assert z == pytest.approx(over + 0.6, abs=2e-3)
