"""Butt, fillet, half V, U and edge: the sections against closed forms, rays and arc light against a walk."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import scenes
from test_arc_map import POSES, arc_at_pixels, arc_frame_of, check_filled, off_by, some_pixels, twin_at_pixels
from test_visibility import open_by_half_spaces

from noise_model.arc.scene import make_scene
from noise_model.condition import Condition
from noise_model.effects import checked
from noise_model.forward import predict
from noise_model.instrument.camera import Rays
from noise_model.surface.joint import REACH_MM, SAGITTA_MM, Joint, seam_height_mm, section
from noise_model.surface.ray_casting import first_hit

RADIUS_MM = 3.0


@pytest.mark.parametrize("name", scenes.MORE_JOINTS)
def test_a_section_is_the_cross_section_as_drawn(name):
    joint = scenes.MORE_JOINTS[name]
    vertices = section(joint).vertices
    assert (vertices[0, 0], vertices[-1, 0]) == (-REACH_MM, REACH_MM)
    assert (np.diff(vertices[:, 0]) >= 0.0).all()
    y = np.linspace(-20.0, 20.0, 4001)[1:-1] + 0.0003
    drawn = np.interp(y, vertices[:, 0], vertices[:, 1])
    # A U's chords lie off its rounding by their sagitta, across it.
    steepest = 1.0 / math.tan(math.radians(15.0))
    atol = SAGITTA_MM * math.hypot(1.0, steepest) if name == "u_groove" else 1e-9
    np.testing.assert_allclose(drawn, scenes.height(joint, np.zeros_like(y), y), atol=atol)


def test_a_us_chords_lie_about_its_rounding():
    joint = scenes.MORE_JOINTS["u_groove"]
    vertices = section(joint).vertices
    middle = np.array([joint.dimensions["root_gap_mm"] / 2.0, 3.0 - joint.dimensions["depth_mm"]])
    share = np.linspace(0.0, 1.0, 51)[:, np.newaxis]
    chords = [(1.0 - share) * a + share * b for a, b in itertools.pairwise(vertices)]
    beside = np.concatenate(chords) - middle
    lower = (beside[:, 0] > 0.0) & (beside[:, 1] < -3.0 * math.sin(math.radians(15.0)))
    off = np.linalg.norm(beside[lower], axis=1) - 3.0
    assert off.min() > -1e-9
    assert 0.5 * SAGITTA_MM < off.max() <= SAGITTA_MM + 1e-9


@pytest.mark.parametrize(
    ("joint_type", "size", "corners"),
    [
        ("butt", {"gap_mm": 1.0, "thickness_mm": 3.0}, [(-0.5, 0), (-0.5, -3), (0.5, -3), (0.5, 0)]),
        ("butt", {"gap_mm": 0.0, "thickness_mm": 3.0}, [(0, 0)]),
        (
            "half_v",
            {"bevel_angle_deg": 45.0, "depth_mm": 4.0, "root_gap_mm": 1.0},
            [(-0.5, 0), (-0.5, -4), (0.5, -4), (4.5, 0)],
        ),
        (
            "half_v",
            {"bevel_angle_deg": 45.0, "depth_mm": 4.0, "root_gap_mm": 0.0},
            [(0, 0), (0, -4), (4, 0)],
        ),
        ("edge", {"gap_mm": 0.0, "thickness_mm": 2.0}, [(-2, -60), (-2, 0), (0, 0), (2, 0), (2, -60)]),
    ],
)
def test_corners_by_hand(joint_type, size, corners):
    vertices = section(Joint(joint_type, size, scenes.LINE)).vertices
    np.testing.assert_allclose(vertices[1:-1], corners, atol=1e-12)
    np.testing.assert_array_equal(vertices[[0, -1], 1], vertices[[1, -2], 1])


@pytest.mark.parametrize("angle_deg", [60.0, 90.0, 179.0, 181.0, 270.0])
def test_a_fillets_plates_enclose_its_angle(angle_deg):
    right, corner, left = section(Joint("fillet", {"included_angle_deg": angle_deg}, scenes.LINE)).vertices
    np.testing.assert_array_equal(corner, 0.0)
    between = math.degrees(math.acos(right @ left / (np.linalg.norm(right) * np.linalg.norm(left))))
    assert (between if left[1] > 0.0 else 360.0 - between) == pytest.approx(angle_deg, abs=1e-6)


def test_a_fillets_foot_stands_off_the_other_plate_by_its_gap():
    size = {"included_angle_deg": 70.0, "gap_mm": 1.5}
    right, foot, below, left = section(Joint("fillet", size, scenes.LINE)).vertices
    along = left / np.linalg.norm(left)
    assert foot[0] * along[1] - foot[1] * along[0] == pytest.approx(-1.5)
    # Both plates go through the corner still.
    for plate in ((right, foot), (left, below)):
        assert np.cross(*(np.append(corner, 0.0) for corner in plate))[2] == pytest.approx(0.0, abs=1e-6)
    assert foot[0] == below[0]


def test_the_seam_is_the_root_of_a_groove_and_the_surface_of_the_others():
    heights = [seam_height_mm(joint) for joint in scenes.MORE_JOINTS.values()]
    assert list(scenes.MORE_JOINTS) == ["butt", "fillet", "ridge", "half_v", "u_groove", "edge"]
    assert heights == [0.0, 0.0, 0.0, -4.0, -6.0, 0.0]


@pytest.mark.parametrize(
    ("key", "name", "changes"),
    [
        ("gap_mm", "butt", {"gap_mm": -0.1}),
        ("thickness_mm", "butt", {"thickness_mm": 0.0}),
        ("included_angle_deg", "fillet", {"included_angle_deg": 180.0}),
        ("included_angle_deg", "fillet", {"included_angle_deg": 360.0}),
        ("included_angle_deg", "fillet", {"included_angle_deg": 0.0}),
        ("gap_mm", "fillet", {"gap_mm": -1.0}),
        ("gap_mm", "ridge", {"gap_mm": 1.0}),
        ("bevel_angle_deg", "half_v", {"bevel_angle_deg": 90.0}),
        ("bevel_angle_deg", "u_groove", {"bevel_angle_deg": 0.0}),
        ("root_radius_mm", "u_groove", {"root_radius_mm": 9.0}),
        ("gap_mm", "edge", {"gap_mm": math.inf}),
    ],
)
def test_a_joint_that_cannot_be_names_its_key(key, name, changes):
    joint = scenes.MORE_JOINTS[name]
    with pytest.raises(ValueError, match=rf"^\[joint\] {key}"):
        dataclasses.replace(joint, dimensions={**joint.dimensions, **changes})


@pytest.mark.parametrize("name", [name for name in scenes.MORE_JOINTS if name != "u_groove"])
def test_hits_agree_with_a_marched_ray(name):
    joint, rng = scenes.MORE_JOINTS[name], np.random.default_rng(4)
    shape = section(joint)
    for _ in range(60):
        origin = rng.uniform([-60.0, -10.0, 60.0], [100.0, 10.0, 150.0])
        d = rng.uniform([-60.0, -6.0, -4.0], [80.0, 6.0, 2.0]) - origin
        t, _ = first_hit(tuple(origin), tuple(d), shape.vertices, shape.corrugation)
        assert t == pytest.approx(scenes.march(joint, origin, d, steps=8000), abs=1e-9)


def surface_points(joint, rng, count):
    """Random points near the seam, with their faces and normals."""
    shape = section(joint)
    for _ in range(count):
        x, y = rng.uniform(-60.0, 80.0), rng.uniform(-8.0, 8.0)
        P = np.array([x, y, float(scenes.height(joint, x, y))])
        _, face = first_hit((x, y, P[2] + 50.0), (0.0, 0.0, -1.0), shape.vertices, shape.corrugation)
        yield P, face, scenes.normal_at(joint, P)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "center"),
    [
        ("butt", (0.0, 0.5, 0.0)),
        ("fillet", (0.0, 1.5, 1.5)),
        ("fillet", (0.0, -1.0, 0.5)),
        ("ridge", (0.0, 0.5, 0.0)),
        ("half_v", (0.0, 0.5, 0.0)),
        ("half_v", (0.0, -6.0, 0.0)),
        ("edge", (0.0, 1.0, 0.0)),
    ],
)
def test_half_spaces_open_the_arc_as_a_walk_does(name, center):
    joint, rng = scenes.MORE_JOINTS[name], np.random.default_rng(6)
    shape, center = section(joint), np.array(center)
    n_hidden = 0
    for P, face, normal in surface_points(joint, rng, 150):
        if np.linalg.norm(P - center) < 1.05 * RADIUS_MM:
            continue
        on_arc, open_by_planes = open_by_half_spaces(shape, P, normal, face, center, rng)
        clearance = scenes.clearance(joint, P, on_arc)
        inside = on_arc[:, 2] < scenes.height(joint, on_arc[:, 0], on_arc[:, 1])
        over_own = (on_arc - P) @ normal
        open_by_walk = (clearance > 0) & ~inside & (over_own > 0)
        sure = (np.abs(clearance) > 1e-3) & (np.abs(over_own) > 1e-6)
        np.testing.assert_array_equal(open_by_planes[sure], open_by_walk[sure])
        n_hidden += np.count_nonzero(~open_by_walk)
    assert n_hidden > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", scenes.MORE_JOINTS)
@pytest.mark.parametrize("pose", ["level", "turned"])
def test_joints_show_the_arc_that_a_walk_finds(name, pose):
    """Within 1 % or 0.25 DN; a U's chords turn its faces by 3 degrees: 8 % there."""
    # A fillet's plates cut into the arc, which stands in their corner.
    setup = scenes.setup(name, "zn_coated", arc_center_mm=(0.0, 0.0, 1.5 if name == "fillet" else 0.0))
    pixels = some_pixels(setup, POSES[pose], 60, seed=9)
    got, _ = arc_at_pixels(setup, POSES[pose], pixels)
    want, _ = twin_at_pixels(setup, POSES[pose], pixels)
    assert want.max() > 1000.0
    assert off_by(got, want).max() < (0.08 if name == "u_groove" else 0.01)


@pytest.mark.parametrize("name", scenes.MORE_JOINTS)
def test_a_frame_filled_by_cells_is_the_frame_pixel_by_pixel(name):
    setup = scenes.setup(
        name,
        of_camera=scenes.camera(width=157, height=119, focal_px=2190.0),
        arc_center_mm=(0.0, 0.0, 2.0 if name == "fillet" else 0.0),
    )
    mean_e, _ = arc_at_pixels(setup, POSES["level"])
    check_filled(arc_frame_of(setup, POSES["level"]), mean_e.reshape(119, 157))


def plain_footprint(view, camera):
    """The camera's rim followed to the highest and the lowest level between the plates and to these."""
    T, vertices = view.T_joint_camera, view.shape.vertices
    u, v = np.meshgrid([0.0, 0.5, 1.0], [0.0, 0.5, 1.0])
    rim = camera.normalised(
        np.column_stack([u.ravel() * (camera.width - 1), v.ravel() * (camera.height - 1)])
    )
    d = np.column_stack([rim, np.ones(9)]) @ T[:3, :3].T
    least = -0.1 * np.linalg.norm(d, axis=1)
    levels = vertices[1:-1, 1].min(), vertices[1:-1, 1].max() + view.shape.corrugation[0]
    ends = [
        T[:2, 3] + ((level - T[2, 3]) / np.minimum(d[:, 2], least))[:, None] * d[:, :2] for level in levels
    ]
    for edge, end in ((vertices[1], vertices[0]), (vertices[-2], vertices[-1])):
        slope = (end[1] - edge[1]) / (end[0] - edge[0])
        if slope != 0.0:
            above = T[2, 3] - edge[1] - slope * (T[1, 3] - edge[0])
            ends.append(T[:2, 3] - (above / np.minimum(d[:, 2] - slope * d[:, 1], least))[:, None] * d[:, :2])
    return np.stack([np.min(ends, axis=(0, 1)), np.max(ends, axis=(0, 1))], axis=1)


@pytest.mark.parametrize("name", [*scenes.JOINTS, *scenes.MORE_JOINTS])
@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 0.0), (5.0, -8.0, 30.0), (70.0, 10.0, 0.0)])
def test_the_footprint_is_its_plain_twins(name, turn_deg):
    setup = scenes.setup(name)
    scene = make_scene(setup, scenes.pose((7.0, -1.0, 2.0), turn_deg))
    np.testing.assert_allclose(scene.footprint_mm, plain_footprint(scene, setup.camera), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", scenes.MORE_JOINTS)
def test_the_footprint_holds_all_that_the_camera_sees(name):
    setup = scenes.setup(name)
    scene = make_scene(setup, POSES["turned"])
    shape = scene.shape
    for xy in Rays.of(setup.camera).xy.reshape(-1, 2)[::37]:
        d = scene.T_joint_camera[:3, :3] @ [xy[0], xy[1], 1.0]
        eye = scene.T_joint_camera[:3, 3]
        t, _ = first_hit(tuple(eye), tuple(d), shape.vertices, shape.corrugation)
        P = eye + t * d
        assert (scene.footprint_mm[:, 0] <= P[:2] + 1e-4).all()
        assert (scene.footprint_mm[:, 1] >= P[:2] - 1e-4).all()


def test_bounced_light_on_a_u_is_refused_by_name():
    setup = dataclasses.replace(
        scenes.setup("u_groove"), effects=checked({"interreflection": {"albedo": 0.5}})
    )
    with pytest.raises(ValueError, match=r"^\[effects\.interreflection\]: .* u_groove"):
        predict(setup, POSES["level"], Condition(laser_level=1.0, arc_level=1.0, exposure_s=0.005))
