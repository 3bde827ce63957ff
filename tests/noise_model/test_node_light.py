"""Sixteen nodes at once against the same, node by node in double precision."""

import numpy as np
import pytest
import scenes

from noise_model.arc.face_lookup import face_seen
from noise_model.arc.map import ArcMap, arc_kernel
from noise_model.arc.node_light import write_faces, write_light, write_places
from noise_model.arc.node_rays import (
    follow_to_lap,
    places_on_plane,
    places_on_rays,
    take_rays,
    tell_faces,
    tell_places,
)
from noise_model.arc.patch_borders import seen_strip
from noise_model.arc.ray import follow
from noise_model.arc.scene import make_scene
from noise_model.arc.scratch import SCRATCH, ArcScratch
from noise_model.arc.table import light_at_places
from noise_model.instrument.camera import Rays
from noise_model.surface.faces import across

N = 16


def drawn(name, rng):
    """The map of a scene that is drawn, its rays, and sixteen pixels of a cell."""
    setup = scenes.setup(name)
    T_base_tool = scenes.pose(rng.uniform(-3.0, 3.0, 3), rng.uniform(-6.0, 6.0, 3))
    rays = Rays.of(setup.camera)
    xy, cos4 = rays.xy.reshape(-1, 2), rays.cos4.reshape(-1)
    height, width = rays.cos4.shape
    arc_map = ArcMap.of(arc_kernel(setup, make_scene(setup, T_base_tool)), xy, cos4, height)
    size = rng.integers(4, 40)
    rows = rng.integers(0, height - size) + np.linspace(0, size - 1, 4).astype(int)
    columns = rng.integers(0, width - size) + np.linspace(0, size - 1, 4).astype(int)
    return arc_map, (rows[:, None] * width + columns).ravel()


def rays_of(arc_map, pixels):
    """Scratch that holds the rays of sixteen pixels."""
    work = ArcScratch.of(arc_map.kernel.vertices)
    work.records[0]["pixels"][:N] = pixels
    take_rays(arc_map.xy, 0, N, work.records[0])
    return work


@pytest.mark.parametrize("name", ["v_groove", "lap", "u_groove"])
def test_nodes_meet_the_faces_that_their_rays_meet(name):
    rng, told = np.random.default_rng(1), 0
    for _ in range(60):
        arc_map, pixels = drawn(name, rng)
        nodes = rays_of(arc_map, pixels).records[0]
        assert write_faces(arc_map.kernel, arc_map.table.seen, nodes)
        tell_faces(0, N, nodes)
        want = [face_seen(arc_map.kernel, arc_map.table.seen, *arc_map.xy[i].tolist()) for i in pixels]
        told += np.count_nonzero(nodes["faces"][:N] == want)
    # Only a ray through an edge itself may meet the other face.
    assert told >= 60 * N - 2


@pytest.mark.parametrize("name", ["v_groove", "lap", "u_groove"])
def test_nodes_receive_what_each_receives(name):
    rng, n_lit = np.random.default_rng(2), 0
    for _ in range(60):
        arc_map, pixels = drawn(name, rng)
        kernel, table, work = arc_map.kernel, arc_map.table, rays_of(arc_map, pixels)
        nodes = work.records[0]
        for face in range(len(kernel.vertices) - 1):
            if not write_places(kernel, face, nodes) or not write_light(kernel, table, face, work):
                continue
            n_lit += 1
            places_on_plane(kernel, face, arc_map.xy, N, nodes)
            light_at_places(kernel, table, arc_map.cos4, N, 0.0, work)
            got_e = nodes["ray_light_e"] * arc_map.cos4[pixels]
            np.testing.assert_allclose(got_e, nodes["light_e"][:N], rtol=2e-4, atol=1e-3)
    assert n_lit > 50


def test_rays_that_do_not_go_down_are_not_told():
    arc_map, pixels = drawn("v_groove", np.random.default_rng(3))
    nodes = rays_of(arc_map, pixels).records[0]
    up = arc_map.kernel._replace(rotation=np.ascontiguousarray(-arc_map.kernel.rotation))
    assert not write_faces(up, arc_map.table.seen, nodes)
    assert not write_places(up, 0, nodes)


def test_nodes_meet_a_corrugated_lap_where_each_ray_does():
    rng, n_told, met = np.random.default_rng(4), 0, set()
    for _ in range(200):
        arc_map, pixels = drawn("corrugation", rng)
        kernel, nodes = arc_map.kernel, rays_of(arc_map, pixels).records[0]
        if not follow_to_lap(kernel, nodes):
            continue
        n_told += 1
        tell_faces(0, N, nodes)
        tell_places(kernel, 0, N, nodes)
        faces, places = nodes["faces"], nodes["places"]
        for i, pixel in enumerate(pixels):
            P, face = follow(kernel, *arc_map.xy[pixel].tolist())
            s = across(P, seen_strip(face, kernel.vertices), kernel.corrugation)
            if abs(s) > 1e-4:
                assert face == faces[i]
                np.testing.assert_allclose(places[i], (P[0], s), atol=2e-4)
                met.add(face)
    assert n_told > 100
    assert met == {0, 1, 2}


@pytest.mark.parametrize("n", [1, 16, 21])
def test_any_number_of_rays_meets_a_corrugated_lap(n):
    rng = np.random.default_rng(5)
    for _ in range(20):
        arc_map, _ = drawn("corrugation", rng)
        kernel, pixels = arc_map.kernel, rng.integers(0, arc_map.cos4.size, n)
        room = np.empty(1, SCRATCH)[0]
        faces, places, room["pixels"][:n] = room["faces"], room["places"], pixels
        faces[:], places[:] = -7, -7.0
        places_on_rays(kernel, arc_map.table.seen, arc_map.xy, n, room)
        want = [follow(kernel, *arc_map.xy[pixel].tolist()) for pixel in pixels]
        np.testing.assert_array_equal(faces[:n], [face for _, face in want])
        np.testing.assert_allclose(places[:n, 0], [P[0] for P, _ in want], atol=2e-4)
        # Nothing is written beyond.
        assert faces[n] == places[n, 0] == -7


def test_rays_that_may_meet_a_ridge_twice_are_not_told():
    arc_map, pixels = drawn("corrugation", np.random.default_rng(6))
    nodes = rays_of(arc_map, pixels).records[0]
    assert follow_to_lap(arc_map.kernel, nodes)
    steeper = arc_map.kernel._replace(corrugation=np.array([40.0, 30.0, 60.0]))
    assert not follow_to_lap(steeper, nodes)
