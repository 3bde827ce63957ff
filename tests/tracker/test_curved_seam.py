"""A seam that turns, from where the sheet cuts it to the torch: closed forms on a circle."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from rendered import LASER_X_MM, small_setup
from scipy.spatial.transform import Rotation

from arctrack.control.pose_watch import nominal_path
from noise_model.arc.scene import make_scene, scene_along
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.joint import seam_frame
from noise_model.transforms import invert, transform
from tracker.seam.expected import expect_seam, ground_at_torch
from tracker.seam.gaussian_process import (
    BEND_LENGTH_MM,
    BEND_SIGMA_MM,
    MODEL_SIGMA_MM,
    WIDE_SIGMA_MM,
    SeamHistory,
)
from tracker.seam.locate import SeamSource, locate, straightened
from tracker.state import N_ROWS, Y_MM, Z_MM

STEP_DEG, START = 0.5, 0.3
LEAN = (0.0, -math.sqrt(0.5), math.sqrt(0.5))
"""A fillet's normal round a pipe on the left: half up, half away from it."""


def on_circle(radius_mm: float, angle_rad: float) -> Float64:
    """The seam's frame on a circle that starts at base's origin along x and turns to the left."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:3, 3] = radius_mm * s, radius_mm * (1.0 - c), 0.0
    return T


def circular(radius_mm: float, leans: bool = False) -> Setup:
    """A lap whose nominal seam is a circle."""
    setup = small_setup("lap")
    frames = [on_circle(radius_mm, angle) for angle in np.radians(np.arange(0.0, 270.1, STEP_DEG))]
    points, normals = (
        tuple((float(x), float(y), float(z)) for x, y, z in vectors)
        for vectors in ((T[:3, 3] for T in frames), (T[:3, :3] @ LEAN for T in frames))
    )
    return replace(
        setup,
        joint=replace(
            setup.joint, seam_in_base_mm=points, surface_normals_in_base=normals if leans else None
        ),
    )


@pytest.mark.parametrize("radius_mm", [50.0, 100.0, 200.0])
@pytest.mark.parametrize("displaced_mm", [0.0, -2.0, 2.0])
def test_a_perfect_sensor_on_a_circle_measures_the_displacement(
    radius_mm: float, displaced_mm: float
) -> None:
    """The tool looks along the tangent at the torch: the sheet at x = l meets the circle at asin(l / r)."""
    setup, T_base_tool = circular(radius_mm), on_circle(radius_mm, START)
    source, history = SeamSource.of(setup), SeamHistory()
    angle = math.asin(LASER_X_MM / (radius_mm - displaced_mm))
    seen_tool = transform(on_circle(radius_mm, angle), np.array([0.0, displaced_mm, 0.0]))
    for station_mm in np.arange(0.0, 150.0, 2.0):
        history = history.with_measurement(float(station_mm), (displaced_mm, 0.0), (1e-6, 1e-6))
    expected = expect_seam(source, T_base_tool, history)
    # Between its points the nominal line is a chord, and the seam is expected on one of them, straight on.
    off_mm = 2.0 * radius_mm * (1.0 - math.cos(math.radians(0.5 * STEP_DEG))) + 0.01
    assert expected.line.station_mm == pytest.approx(radius_mm * (START + angle), abs=0.2)
    assert expected.torch_mm == pytest.approx(radius_mm * START, abs=0.01)
    scene = make_scene(setup, T_base_tool, expected.line)
    _, y, z = transform(scene.T_joint_tool, seen_tool)
    assert y == pytest.approx(0.0, abs=0.1)
    found = locate(source, T_base_tool, scene, float(y), float(z))
    assert found.seam_tool_mm == pytest.approx(tuple(seen_tool), abs=1e-6)
    assert found.station_mm == pytest.approx(radius_mm * (START + angle), abs=0.05)
    assert found.displacement_mm == pytest.approx((displaced_mm, 0.0), abs=off_mm)


def test_a_displaced_torch_does_not_change_what_is_measured() -> None:
    """Beside its path the sensor's axis meets another place of the circle than the sheet does."""
    setup, radius_mm = circular(50.0), 50.0
    source = SeamSource.of(setup)
    for aside_mm in (-5.0, 0.0, 5.0):
        T_base_tool = on_circle(radius_mm, START)
        T_base_tool[:3, 3] = transform(T_base_tool, np.array([0.0, aside_mm, 0.0]))
        line = expect_seam(source, T_base_tool, SeamHistory()).line
        assert line.station_mm == pytest.approx(
            radius_mm * (START + math.asin(LASER_X_MM / radius_mm)), abs=0.2
        )


def test_the_arc_stands_on_the_circle_under_the_torch() -> None:
    setup, T_base_tool = circular(100.0), on_circle(100.0, START)
    source = SeamSource.of(setup)
    expected = expect_seam(source, T_base_tool, SeamHistory())
    ground = ground_at_torch(source, expected, expected.segment, expected.line)
    assert ground is not None
    torch = transform(expected.T_joint_tool, np.zeros(3))
    assert (ground.station_mm, ground.y_mm, ground.z_mm) == pytest.approx(tuple(torch), abs=0.01)
    straight = small_setup("lap")
    along = expect_seam(SeamSource.of(straight), np.eye(4), SeamHistory())
    assert ground_at_torch(SeamSource.of(straight), along, 0, along.line) is None


def test_a_normal_that_turns_with_the_seam_turns_its_frames() -> None:
    """A fillet round a pipe: tracker and bus see the same left and up at each place."""
    joint = circular(50.0, leans=True).joint
    path = nominal_path(joint)
    for angle in (0.2, 1.0, 3.0):
        T_base_seam = on_circle(50.0, angle)
        x, y, z = T_base_seam[:3, 3].tolist()
        frame, segment = seam_frame(joint, T_base_seam[:3, 3]), path.segments[path.place((x, y, z)).segment]
        np.testing.assert_allclose(frame[:3, 2], T_base_seam[:3, :3] @ LEAN, atol=0.01)
        np.testing.assert_allclose(frame[:3, 2], segment.up, atol=1e-9)
        np.testing.assert_allclose(frame[:3, 1], segment.left, atol=1e-9)


def test_normals_that_do_not_fit_the_line_are_refused() -> None:
    joint = circular(50.0, leans=True).joint
    assert joint.surface_normals_in_base is not None
    with pytest.raises(ValueError, match="one normal for each point of seam_in_base_mm"):
        replace(joint, surface_normals_in_base=joint.surface_normals_in_base[1:])
    with pytest.raises(ValueError, match="a length is not 1"):
        replace(joint, surface_normals_in_base=tuple((0.0, 0.0, 2.0) for _ in joint.seam_in_base_mm))


def cornered(*points_mm: tuple[float, float, float]) -> SeamSource:
    setup = small_setup("lap")
    return SeamSource.of(replace(setup, joint=replace(setup.joint, seam_in_base_mm=points_mm)))


def displaced_part(source: SeamSource, w_base: Float64, stations_mm: Float64) -> SeamHistory:
    """Exact measurements of a part that lies displaced as a whole."""
    history = SeamHistory()
    for station_mm, axes in zip(stations_mm, source.line.at(stations_mm), strict=True):
        y_mm, z_mm = axes @ w_base
        history = history.with_measurement(float(station_mm), (y_mm, z_mm), (1e-6, 1e-6))
    return history


def test_on_a_line_that_turns_the_process_is_that_of_all_places_at_once() -> None:
    """Against Gaussian conditioning on every measurement by one covariance matrix."""
    source = SeamSource.of(circular(50.0))
    x, asked_mm = np.arange(20.0, 60.0, 2.0), np.array([0.0, 21.0, 41.3, 75.0])
    draw, history = np.random.default_rng(1), SeamHistory()
    seen_mm = draw.normal(0.0, 1.0, (len(x), 2))
    for station_mm, y_z_mm in zip(x, seen_mm, strict=True):
        history = history.with_measurement(float(station_mm), y_z_mm, (1e-2, 4e-2))
    places = np.concatenate([x, asked_mm])
    shown = np.concatenate(source.line.at(places).transpose(1, 0, 2))
    r = math.sqrt(3.0) / BEND_LENGTH_MM * np.abs(places[:, None] - places)
    bend = np.kron(np.eye(2), BEND_SIGMA_MM**2 * (1.0 + r) * np.exp(-r))
    K = bend + WIDE_SIGMA_MM**2 * shown @ shown.T
    n, k = len(x), len(places)
    known = np.r_[:n, k : k + n]
    noise = np.repeat([1e-2, 4e-2], n) + MODEL_SIGMA_MM**2
    gain = np.linalg.solve(K[np.ix_(known, known)] + np.diag(noise), K[known]).T
    mean, variance = gain @ seen_mm.T.ravel(), np.diag(K - gain @ K[known])
    for i, station_mm in enumerate(asked_mm):
        there = source.seam_at(history, float(station_mm))
        rows = [n + i, k + n + i]
        assert there.displacement_mm == pytest.approx(tuple(mean[rows]), abs=1e-6)
        assert there.sigma_mm == pytest.approx(tuple(np.sqrt(variance[rows])), rel=1e-6)


def test_a_place_behind_a_corner_tells_what_the_torch_meets_in_it() -> None:
    """The sensor is blind for 10 mm behind the corner; the part lies displaced along the first leg too."""
    source, w_base = cornered((0.0, 0.0, 0.0), (60.0, 0.0, 0.0), (60.0, 90.0, 0.0)), np.array([2.0, 1.0, 0.5])
    before = displaced_part(source, w_base, np.arange(10.0, 58.0))
    behind = source.seam_at(before, 70.0)
    assert behind.sigma_mm[0] > 4.0 > 0.2 > behind.sigma_mm[1]
    both = displaced_part(source, w_base, np.append(np.arange(10.0, 58.0), np.arange(70.0, 80.0)))
    for station_mm, y_mm in ((50.0, 1.0), (63.0, -2.0), (69.0, -2.0)):
        there = source.seam_at(both, station_mm)
        assert there.displacement_mm == pytest.approx((y_mm, 0.5), abs=0.02)
        assert max(there.sigma_mm) < 0.15


@pytest.mark.parametrize("radius_mm", [50.0, 100.0])
@pytest.mark.parametrize("turned_deg", [0.0, 15.0, 30.0])
def test_a_section_of_a_pipe_that_is_cut_askew_is_straightened(radius_mm: float, turned_deg: float) -> None:
    """The level plate about a pipe: each of its points is as far from the root as on its own circle."""
    source, T_base_tool = SeamSource.of(circular(radius_mm, leans=True)), on_circle(radius_mm, START)
    T_base_tool[:3, :3] @= Rotation.from_euler("z", turned_deg, degrees=True).as_matrix()
    line = expect_seam(source, T_base_tool, SeamHistory()).line
    scene = scene_along(source.scene, T_base_tool, line)
    normal, T_joint_base = T_base_tool[:3, :3] @ source.plane[:3], scene.T_joint_tool @ invert(T_base_tool)
    off_mm = source.plane[3] - normal @ T_base_tool[:3, 3]
    points, across_mm, angles = np.zeros((N_ROWS, 9)), np.linspace(0.0, 8.0, 9), np.arange(0.0, 1.5, 1e-4)
    for k, far_mm in enumerate(radius_mm + across_mm):
        ring = np.column_stack([far_mm * np.sin(angles), radius_mm - far_mm * np.cos(angles), 0.0 * angles])
        on_sheet = ring[np.argmin(np.abs(ring @ normal + off_mm))]
        points[[Y_MM, Z_MM], k] = transform(T_joint_base, on_sheet)[1:]
    shown = straightened(source, scene, line.station_mm, 5.0, points)
    root = math.sqrt(0.5)
    np.testing.assert_allclose(shown[Y_MM], -root * across_mm, atol=0.02)
    np.testing.assert_allclose(shown[Z_MM], root * across_mm, atol=0.02)


def test_a_section_is_unsure_where_the_turn_begins_not_within_it() -> None:
    crossing = math.cos(math.radians(20.0))
    round_all = SeamSource.of(circular(50.0))
    assert round_all.turn_mm(70.0, crossing) == pytest.approx(0.0, abs=1e-3)
    corner = cornered((0.0, 0.0, 0.0), (60.0, 0.0, 0.0), (60.0, 90.0, 0.0))
    assert corner.turn_mm(57.0, crossing) > 0.1
    assert corner.turn_mm(30.0, crossing) == 0.0
    assert SeamSource.of(small_setup("lap")).turn_mm(30.0, 0.5) == 0.0
