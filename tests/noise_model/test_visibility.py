import math

import numpy as np
import pytest
import scenes
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from noise_model.surface.faces import face_normal
from noise_model.surface.joint import corrugation_height, section
from noise_model.surface.ray_casting import MISS, first_hit, trace, way_is_open, ways_are_open
from noise_model.surface.visibility import (
    HORIZON_STEP_MM,
    MAX_LEDGES,
    MAX_PLANES,
    horizons_of_scenes,
    lap_planes,
    sky_planes,
    steepest,
    write_horizon,
)

GRAZED_MM = 0.01
"""How deep a ray may dip into a corrugation's crest unseen: its way there is followed in steps."""

RADIUS_MM = 3.0
unit_share = st.floats(0.0, 1.0)
names = st.sampled_from(list(scenes.JOINTS))
stations = st.floats(-70.0, 90.0)
sides = st.floats(-25.0, 25.0)
slow = settings(max_examples=150, deadline=None)


def hit(joint, origin, d):
    shape = section(joint)
    return first_hit(tuple(origin), tuple(d), shape.vertices, shape.corrugation)


def check_hit(joint, origin, d):
    """The ray's way to the hit is free on the side that it starts from, and the hit is on the surface."""
    t, face = hit(joint, origin, d)
    end = min(t, 400.0 / float(np.linalg.norm(d)))
    walk = origin + np.linspace(0.0, end, 4001)[:-1, np.newaxis] * d
    gap = walk[:, 2] - scenes.height(joint, walk[:, 0], walk[:, 1])
    side = 1.0 if gap[0] > 0 else -1.0
    # A step past a wall is still before it; the sheet's own edge is that of the nearer side.
    assert np.min(side * gap) > -GRAZED_MM, (t, face)
    assert (face == MISS) == math.isinf(t)
    if face == MISS:
        return
    P = origin + t * d
    heights = [float(scenes.height(joint, P[0], P[1] + e)) for e in (-1e-7, 1e-7)]
    assert min(heights) - 1e-6 <= P[2] <= max(heights) + 1e-6


@slow
@given(names, stations, sides, st.floats(30.0, 160.0), stations, sides, st.floats(-4.0, 9.5))
def test_a_cameras_ray_stops_at_the_surface(name, x, y, z, to_x, to_y, to_z):
    origin = np.array([x, y, z])
    check_hit(scenes.JOINTS[name], origin, np.array([to_x, to_y, to_z]) - origin)


@pytest.mark.slow
@slow
@given(names, stations, sides, st.floats(0.05, 12.0), stations, sides, st.floats(-4.0, 12.0))
def test_a_ray_along_the_ground_stops_at_the_surface(name, x, y, above, to_x, to_y, to_z):
    joint = scenes.JOINTS[name]
    origin = np.array([x, y, float(scenes.height(joint, x, y)) + above])
    d = np.array([to_x, to_y, to_z]) - origin
    # A ray that begins on a lap's edge has no side that it starts from.
    assume(np.linalg.norm(d) > 1e-3 and abs(y) > 1e-6)
    check_hit(joint, origin, d)


@slow
@given(names, stations, sides, st.floats(-30.0, -4.5), stations, sides, st.floats(-4.0, 9.5))
def test_a_ray_from_below_stops_at_the_surfaces_other_side(name, x, y, z, to_x, to_y, to_z):
    origin = np.array([x, y, z])
    d = np.array([to_x, to_y, to_z]) - origin
    check_hit(scenes.JOINTS[name], origin, d)
    if d[2] > 1.0:
        assert hit(scenes.JOINTS[name], origin, d)[1] != MISS


@settings(deadline=None)
@given(names, stations, sides, st.floats(12.0, 160.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), unit_share)
def test_a_ray_that_leaves_the_workpiece_meets_nothing(name, x, y, z, d_x, d_y, d_z):
    assert hit(scenes.JOINTS[name], np.array([x, y, z]), np.array([d_x, d_y, d_z])) == (math.inf, MISS)


@pytest.mark.parametrize("name", scenes.JOINTS)
def test_hits_agree_with_a_marched_ray(name):
    joint, rng = scenes.JOINTS[name], np.random.default_rng(4)
    for _ in range(60):
        origin = rng.uniform([-60.0, -30.0, 60.0], [100.0, 30.0, 150.0])
        d = rng.uniform([-60.0, -20.0, -4.0], [80.0, 20.0, 9.0]) - origin
        t, _ = hit(joint, origin, d)
        assert t == pytest.approx(scenes.march(joint, origin, d, steps=4000), abs=1e-9)


@pytest.mark.parametrize("d", [(0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)])
@pytest.mark.parametrize("name", scenes.JOINTS)
def test_a_ray_along_an_axis_is_a_ray_too(name, d):
    check_hit(scenes.JOINTS[name], np.array([22.0, 4.5, 1.0]), np.array(d))
    assert hit(scenes.JOINTS[name], np.array([22.0, 4.5, 1.0]), np.zeros(3))[1] == MISS


def test_nothing_slips_through_where_faces_meet():
    for joint in scenes.JOINTS.values():
        origin = np.array([70.0, 0.0, 120.0])
        for y in section(joint).vertices[1:-1, 0]:
            foot = np.array([20.0, y, float(scenes.height(joint, 20.0, y))])
            t, face = hit(joint, origin, foot - origin)
            assert face != MISS
            assert t == pytest.approx(1.0, abs=0.1)


@given(names, stations, sides)
@settings(deadline=None)
def test_a_faces_normal_is_the_surfaces(name, x, y):
    joint = scenes.JOINTS[name]
    shape = section(joint)
    assume(np.min(np.abs(shape.vertices[:, 0] - y)) > 1e-3)
    if name == "corrugation":
        # Where a corrugation ends its curvature jumps, and differences straddle it.
        assume(scenes.corrugation(joint, np.array(x)) > 1e-3)
    _, face = hit(joint, np.array([x, y, 50.0]), np.array([0.0, 0.0, -1.0]))
    normal = face_normal(face, x, shape.vertices, shape.corrugation)
    P = np.array([x, y, float(scenes.height(joint, x, y))])
    np.testing.assert_allclose(normal, scenes.normal_at(joint, P), atol=1e-5)


def test_a_laps_edge_faces_the_lower_sheet():
    for name in ("lap", "corrugation"):
        shape = section(scenes.JOINTS[name])
        normal = face_normal(1, 7.0, shape.vertices, shape.corrugation)
        np.testing.assert_array_equal(normal, [0.0, 1.0, 0.0])


def test_trace_says_nan_where_a_ray_misses():
    shape = section(scenes.JOINTS["lap"])
    T_joint_camera = np.diag([1.0, -1.0, -1.0, 1.0])[np.newaxis]
    T_joint_camera[0, 2, 3] = 100.0
    which = np.zeros(3, dtype=np.int64)
    xy = np.array([[0.1, -0.1], [0.1, 0.1], [1e5, 0.0]])
    points, normals, faces = np.empty((3, 3)), np.empty((3, 3)), np.empty(3, dtype=np.int32)
    trace(xy, which, T_joint_camera, shape.vertices, shape.corrugation, points, normals, faces)
    np.testing.assert_allclose(points[:2], [[10.0, 10.0, 0.0], [9.8, -9.8, 2.0]], atol=1e-12)
    np.testing.assert_array_equal(faces[:2], [2, 0])
    T_joint_camera[0, :3, :3] = np.eye(3)
    trace(xy, which, T_joint_camera, shape.vertices, shape.corrugation, points, normals, faces)
    assert np.isnan(points).all()
    assert np.isnan(normals).all()
    np.testing.assert_array_equal(faces, MISS)


def surface_points(joint, rng, count):
    """Random points near the seam, some of them on a lap's edge; with their faces and normals."""
    for _ in range(count):
        x, y = rng.uniform(-60.0, 80.0), rng.uniform(-8.0, 8.0)
        if joint.type in ("lap", "corrugation") and rng.random() < 0.25:
            foot = float(scenes.height(joint, x, 1.0))
            P = np.array([x, 0.0, foot + joint.dimensions["thickness_mm"] * rng.uniform(0.02, 0.98)])
            yield P, 1, np.array([0.0, 1.0, 0.0])
            continue
        P = np.array([x, y, float(scenes.height(joint, x, y))])
        _, face = hit(joint, np.add(P, [0.0, 0.0, 50.0]), np.array([0.0, 0.0, -1.0]))
        yield P, face, scenes.normal_at(joint, P)


@pytest.mark.slow
@pytest.mark.parametrize("name", scenes.JOINTS)
@pytest.mark.parametrize("height_mm", [140.0, 20.0])
def test_the_way_to_a_source_is_open_as_a_walk_finds_it(name, height_mm):
    joint, rng = scenes.JOINTS[name], np.random.default_rng(5)
    shape = section(joint)
    n_hidden = 0
    for P, _, normal in surface_points(joint, rng, 400):
        Q = np.array([P[0] + rng.uniform(-60.0, 60.0), rng.uniform(-30.0, 30.0), height_mm])
        if (Q - P) @ normal <= 0.0:
            continue
        clearance = scenes.clearance(joint, P, Q[np.newaxis])[0]
        # On a corrugation both walk in steps; between them a crest may rise by this much.
        if abs(clearance) > (0.05 if name == "corrugation" else 1e-6):
            assert way_is_open(P, Q, shape.vertices, shape.corrugation) == (clearance > 0), (P, Q, clearance)
            n_hidden += clearance < 0
    assert n_hidden > 0 or name == "flat" or height_mm > 100.0


def test_ways_are_open_is_way_is_open_for_many():
    shape = section(scenes.JOINTS["lap"])
    points = np.array([[0.0, 0.5, 0.0], [0.0, 5.0, 0.0], [0.0, -5.0, 2.0]])
    is_free = np.empty(3, dtype=np.bool_)
    ways_are_open(points, np.array([0.0, -60.0, 100.0]), shape.vertices, shape.corrugation, is_free)
    np.testing.assert_array_equal(is_free, [False, True, True])


def horizon_tables(shape, center):
    """The start and the horizon tables of one scene that is seen from -70 to 90 mm."""
    starts, tables = horizons_of_scenes(
        shape, np.array([[-70.0, 90.0]]), center[np.newaxis].copy(), RADIUS_MM, True
    )
    return starts[0], tables[0]


def open_by_half_spaces(shape, P, normal, face, center, rng):
    """Points (n, 3) of the arc that face a surface point, and which of them its half-spaces open."""
    planes, ledges = np.empty((MAX_PLANES, 3)), np.empty((2 * MAX_LEDGES, 3))
    count, n_ledges = sky_planes(
        tuple(P),
        tuple(normal),
        face,
        tuple(center),
        RADIUS_MM,
        (0.0, 0.0),
        shape.vertices,
        planes,
        ledges,
    )
    outward = rng.normal(size=(40, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    outward[:, 2] = np.abs(outward[:, 2])
    on_arc = center + RADIUS_MM * outward
    on_arc = on_arc[np.sum((P - on_arc) * outward, axis=1) > 0]
    open_by_planes = ((on_arc - P) @ planes[:count].T > 0).all(axis=1)
    for rim, (n_y, n_z, c) in zip(ledges[: 2 * n_ledges : 2], ledges[1 : 2 * n_ledges : 2], strict=True):
        behind = n_y * on_arc[:, 1] + n_z * on_arc[:, 2] < c
        open_by_planes &= ~behind | ((on_arc - P) @ rim > 0)
    return on_arc, open_by_planes


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "center"),
    [
        ("v_groove", (0.0, 0.5, 0.0)),
        ("v_groove", (0.0, -9.0, 0.0)),
        ("lap", (0.0, 0.0, 2.0)),
        ("lap", (0.0, -2.0, 2.0)),
        ("lap", (0.0, 4.0, 0.5)),
        ("lap", (0.0, -5.0, 4.0)),
        ("lap", (0.0, 0.5, 0.0)),
        ("lap", (0.0, -1.0, 1.0)),
        ("v_groove", (0.0, 0.3, -2.0)),
    ],
)
def test_half_spaces_open_the_arc_as_a_walk_does(name, center):
    joint, rng = scenes.JOINTS[name], np.random.default_rng(6)
    shape, center = section(joint), np.array(center)
    n_hidden = 0
    for P, face, normal in surface_points(joint, rng, 150):
        if np.linalg.norm(P - center) < 1.05 * RADIUS_MM:
            continue
        on_arc, open_by_planes = open_by_half_spaces(shape, P, normal, face, center, rng)
        clearance = scenes.clearance(joint, P, on_arc)
        inside = on_arc[:, 2] < scenes.height(joint, on_arc[:, 0], on_arc[:, 1])
        open_by_walk = (clearance > 0) & ~inside & ((on_arc - P) @ normal > 0)
        sure = np.abs(clearance) > 1e-6
        np.testing.assert_array_equal(open_by_planes[sure], open_by_walk[sure])
        n_hidden += np.count_nonzero(~open_by_walk)
    assert n_hidden > 0


def horizon_table(x_start, n, center_x, radius, corrugation, lift, foot):
    stations = x_start + HORIZON_STEP_MM * np.arange(n)
    heights, table = corrugation_height(stations, corrugation), np.empty((n, 2))
    room = np.empty(n, np.int64)
    write_horizon(heights, x_start, (0, n), (center_x, radius), lift, foot, table, room)
    return table


def steepest_on_the_way(heights, i, x_start, center_x, radius, lift, foot):
    """What `write_horizon` says of a station, by a look at each one on the way: the slope and its place."""
    stations = x_start + HORIZON_STEP_MM * np.arange(len(heights))
    towards = -1.0 if stations[i] > center_x else 1.0
    way, to_center = (stations - stations[i]) * towards, (center_x - stations) * towards
    slopes = np.full(len(heights), -np.inf)
    slopes[way > 0.0] = ((heights + lift - heights[i])[way > 0.0]) / way[way > 0.0]
    is_under = (to_center < radius) & (to_center >= -radius) & (slopes > 0.0) & (heights <= foot)
    slopes[~((to_center >= radius) | is_under)] = -np.inf
    steepest = int(np.argmax(slopes))
    return slopes[steepest], stations[steepest] if slopes[steepest] > -np.inf else np.nan


@given(st.integers(0, 2**32 - 1))
def test_the_horizon_is_that_of_a_look_at_each_station(seed):
    rng = np.random.default_rng(seed)
    n, x_start = int(rng.integers(1, 90)), HORIZON_STEP_MM * int(rng.integers(-60, 20))
    heights = rng.choice([0.05, 1.0]) * rng.normal(size=n).cumsum() + rng.normal(0.0, 0.2, n)
    center_x, radius = rng.uniform(-16.0, 16.0), rng.uniform(0.1, 4.0)
    lift, foot = rng.uniform(-2.0, 1.0), rng.normal()
    first = int(rng.integers(0, n))
    table, untouched = np.full((n, 2), -7.0), np.full((n, 2), -7.0)
    last = int(rng.integers(first, n + 1))
    room = np.empty(n, np.int64)
    write_horizon(heights, x_start, (first, last), (center_x, radius), lift, foot, table, room)
    for i in range(first, last):
        slope, where = steepest_on_the_way(heights, i, x_start, center_x, radius, lift, foot)
        np.testing.assert_allclose(table[i], (slope, where), rtol=1e-9, atol=1e-12)
    untouched[first:last] = table[first:last]
    np.testing.assert_array_equal(table, untouched)


@pytest.mark.parametrize(("center_x", "lift"), [(0.0, 0.0), (12.0, 0.0), (30.0, -1.5)])
def test_the_horizon_is_the_steepest_slope_on_the_way(center_x, lift):
    joint = scenes.JOINTS["corrugation"]
    corrugation = section(joint).corrugation
    # No terrain counts as below the arc here, so that it ends at the near side.
    table = horizon_table(-80.0, 700, center_x, RADIUS_MM, corrugation, lift, -1.0)
    for i in range(0, 700, 7):
        x = -80.0 + i * HORIZON_STEP_MM
        towards = 1.0 if x < center_x else -1.0
        way = np.linspace(x + towards * HORIZON_STEP_MM, center_x - towards * RADIUS_MM, 4001)
        if (way[-1] - way[0]) * towards <= 2.0 * HORIZON_STEP_MM:
            continue
        rise = scenes.corrugation(joint, way) + lift - float(scenes.corrugation(joint, np.array(x)))
        slopes = rise / np.abs(way - x)
        # The table's stations miss the touching point by half a step at the most.
        assert table[i, 0] == pytest.approx(float(np.max(slopes)), abs=0.01)
        if lift == 0.0:
            assert table[i, 0] == pytest.approx(
                float(np.interp(table[i, 1] * towards, way * towards, slopes)), abs=0.003
            )


@pytest.mark.parametrize("seed", range(20))
def test_the_steepest_slope_from_a_point_is_its_rows_of_the_horizon(seed):
    rng = np.random.default_rng(seed)
    corrugation = section(scenes.JOINTS["corrugation"]).corrugation
    x = HORIZON_STEP_MM * rng.integers(-240, 240)
    center_x, lift, foot = rng.uniform(-60.0, 60.0), rng.uniform(-2.0, 1.0), rng.uniform(0.0, 8.0)
    # The table ends where no terrain is looked at any more.
    start = min(x, center_x - RADIUS_MM) - 1.0
    n = int((max(x, center_x + RADIUS_MM) - start) / HORIZON_STEP_MM) + 8
    start = x - HORIZON_STEP_MM * round((x - start) / HORIZON_STEP_MM)
    row = round((x - start) / HORIZON_STEP_MM)
    want = horizon_table(start, n, center_x, RADIUS_MM, corrugation, lift, foot)[row, 0]
    P = (x, 0.0, float(corrugation_height(np.array(x), corrugation)) - lift)
    got = steepest(P, 0.0, (center_x, 0.0, foot), RADIUS_MM, corrugation)
    assert got == want or got == pytest.approx(want, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("arc_height_mm", [1.5, 4.0])
@pytest.mark.parametrize("station_mm", [0.0, 12.0, 30.0])
def test_a_ridge_hides_the_arc_as_a_walk_finds_it(station_mm, arc_height_mm):
    """On one sheet, where the edge plays no part: the plane that touches the ridge."""
    joint, rng = scenes.JOINTS["corrugation"], np.random.default_rng(7)
    shape = section(joint)
    center = np.array(
        [station_mm, 12.0, arc_height_mm + float(scenes.corrugation(joint, np.array(station_mm)))]
    )
    start, horizons = horizon_tables(shape, center)
    planes = np.empty((MAX_PLANES, 3))
    n_wrong = n_hidden = n_looked = 0
    for _ in range(120):
        x, y = rng.uniform(-65.0, 85.0), rng.uniform(4.0, 20.0)
        P = np.array([x, y, float(scenes.height(joint, x, y))])
        if abs(x - station_mm) < 2.0 * RADIUS_MM:
            continue
        normal = scenes.normal_at(joint, P)
        count, _ = lap_planes(
            tuple(P),
            tuple(normal),
            2,
            tuple(center),
            RADIUS_MM,
            (0.0, 0.0),
            shape.vertices,
            shape.corrugation,
            start,
            horizons,
            planes,
        )
        outward = rng.normal(size=(60, 3))
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        outward[:, 2] = np.abs(outward[:, 2])
        on_arc = center + RADIUS_MM * outward
        on_arc = on_arc[(np.sum((P - on_arc) * outward, axis=1) > 0) & ((on_arc - P) @ normal > 0)]
        if not len(on_arc):
            continue
        open_by_planes = ((on_arc - P) @ planes[:count].T > 0).all(axis=1)
        clearance = scenes.clearance(joint, P, on_arc)
        # A walk begins on the surface and so ends at about 0; what is hidden is so by more.
        is_hidden = clearance < -0.02
        sure = is_hidden | (clearance > -1e-4)
        n_wrong += np.count_nonzero((open_by_planes == is_hidden) & sure)
        n_hidden += np.count_nonzero(is_hidden)
        n_looked += np.count_nonzero(sure)
    assert n_hidden > 50
    assert n_wrong <= 0.002 * n_looked
