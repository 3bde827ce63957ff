"""Sixteen nodes at once against the same, node by node in double precision."""

import numpy as np
import pytest
import scenes

from noise_model.arc.face_lookup import face_seen
from noise_model.arc.map import ArcMap, arc_kernel
from noise_model.arc.node_light import node_rays, take_rays, write_faces, write_light
from noise_model.arc.ray import scratch
from noise_model.arc.scene import make_scene
from noise_model.arc.table import light_at_places, places_on_plane
from noise_model.instrument.camera import Rays

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


@pytest.mark.parametrize("name", ["v_groove", "lap", "u_groove"])
def test_nodes_meet_the_faces_that_their_rays_meet(name):
    rng, told = np.random.default_rng(1), 0
    for _ in range(60):
        arc_map, pixels = drawn(name, rng)
        nodes, faces = node_rays(), np.empty(N, np.int64)
        take_rays(arc_map.xy, arc_map.cos4, pixels, nodes)
        assert write_faces(arc_map.kernel, arc_map.table.seen, nodes, faces)
        want = [face_seen(arc_map.kernel, arc_map.table.seen, *arc_map.xy[i].tolist()) for i in pixels]
        told += np.count_nonzero(faces == want)
    # Only a ray through an edge itself may meet the other face.
    assert told >= 60 * N - 2


@pytest.mark.parametrize("name", ["v_groove", "lap", "u_groove"])
def test_nodes_receive_what_each_receives(name):
    rng, n_lit = np.random.default_rng(2), 0
    for _ in range(60):
        arc_map, pixels = drawn(name, rng)
        kernel, table, work = arc_map.kernel, arc_map.table, scratch()
        nodes, faces = node_rays(), np.empty(N, np.int64)
        take_rays(arc_map.xy, arc_map.cos4, pixels, nodes)
        places, want_e, got_e = np.empty((N, 2)), np.empty(N), np.empty(N)
        for face in range(len(kernel.vertices) - 1):
            if not write_light(kernel, table, face, nodes, got_e, work):
                continue
            n_lit += 1
            places_on_plane(kernel, face, arc_map.xy, pixels, N, faces, places)
            light_at_places(kernel, table, arc_map.cos4, pixels, N, faces, places, 0.0, want_e, work)
            np.testing.assert_allclose(got_e, want_e, rtol=2e-4, atol=1e-3)
    assert n_lit > 50


def test_rays_that_do_not_go_down_are_not_told():
    arc_map, pixels = drawn("v_groove", np.random.default_rng(3))
    nodes = node_rays()
    take_rays(arc_map.xy, arc_map.cos4, pixels, nodes)
    up = arc_map.kernel._replace(rotation=np.ascontiguousarray(-arc_map.kernel.rotation))
    assert not write_faces(up, arc_map.table.seen, nodes, np.empty(N, np.int64))
    assert not write_light(up, arc_map.table, 0, nodes, np.empty(N), scratch())
