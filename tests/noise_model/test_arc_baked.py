"""Light that is baked about a nominal pose, against each pixel's own integral."""

import dataclasses

import numpy as np
import pytest
import scenes
from hypothesis import given, settings
from hypothesis import strategies as st

from noise_model.arc.baked import BRIGHTEST, N_LATERAL, NOTHING_BAKED, REACH_MM, STEP_MM
from noise_model.arc.map import CELL, ArcMap, arc_at, arc_kernel, baked_light
from noise_model.arc.scene import make_scene
from noise_model.instrument.camera import Rays
from noise_model.surface.joint import SeamLine

TOLERANCE, HALF_PERCENT, QUARTER_DN_E = 0.01, 0.005, 20.0


def sensor(joint, material="zn_coated"):
    """A small camera's setup, its rays, and the light that is baked for it."""
    setup = scenes.setup(joint, material, of_camera=scenes.camera(width=160, height=120, focal_px=1100.0))
    rays = Rays.of(setup.camera)
    xy, cos4 = rays.xy.reshape(-1, 2), rays.cos4.reshape(-1)
    nominal = arc_kernel(setup, make_scene(setup, scenes.pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))))
    return setup, xy, cos4, baked_light(nominal, xy, 120, TOLERANCE, QUARTER_DN_E)


def kernel_at(setup, shift=(0.0, 0.0, 0.0), turn_deg=(0.0, 0.0, 0.0), level=1.0):
    return arc_kernel(setup, make_scene(setup, scenes.pose(shift, turn_deg)), level)


def frame(arc_map, shape=(120, 160)):
    frame_e = np.empty(shape, dtype=np.float32)
    arc_map.fill(np.zeros(-(-shape[0] // CELL), dtype=np.int64), frame_e)
    return frame_e.reshape(-1)


def map_of(kernel, xy, cos4, baked):
    return ArcMap.of(kernel, xy, cos4, 120, TOLERANCE, QUARTER_DN_E, baked)


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["v_groove", "lap", "flat"])
@pytest.mark.parametrize("glossier", [1.0, 4.0])
@given(
    shift=st.tuples(st.floats(-30.0, 30.0), st.floats(-2.0, 2.0), st.floats(-3.0, 3.0)),
    turn_deg=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    level=st.floats(0.3, BRIGHTEST),
)
@settings(max_examples=6, deadline=None, derandomize=True)
def test_baked_light_is_each_pixels_own(joint, glossier, shift, turn_deg, level):
    material = scenes.TABLE_1["zn_coated"]
    setup, xy, cos4, baked = sensor(joint, dataclasses.replace(material, c2=glossier * material.c2))
    kernel = kernel_at(setup, shift, turn_deg, level)
    arc_map = map_of(kernel, xy, cos4, baked)
    assert arc_map.table.is_ready.any()
    want, _ = arc_at(kernel, xy, cos4, np.arange(cos4.size))
    error = np.abs(frame(arc_map) - want) / np.maximum(HALF_PERCENT * want, QUARTER_DN_E)
    # What both leave out, the integral of few nodes and the cells of the image, is in it.
    assert np.nanquantile(error, 0.99) < 1.0
    assert np.mean(error > 1.0) < 0.003


@pytest.mark.parametrize("joint", ["v_groove", "lap"])
def test_light_of_another_scene_is_integrated(joint):
    """An estimator of the arc's height asks for light of an arc that the setup does not state."""
    setup, xy, cos4, baked = sensor(joint)
    near = kernel_at(setup)
    c_x, c_y, c_z = near.center
    for kernel in (
        near._replace(radius=1.01 * near.radius),
        near._replace(center=(c_x, c_y, c_z + 0.01)),
        near._replace(material=(1.01 * near.material[0], *near.material[1:])),
        near._replace(vertices=near.vertices + np.array([0.0, 0.01])),
        near._replace(vertices=near.vertices[1:]),
    ):
        assert not map_of(kernel, xy, cos4, baked).table.is_ready.any()


@pytest.mark.parametrize("joint", ["v_groove", "lap"])
def test_light_far_from_the_nominal_pose_is_integrated(joint):
    setup, xy, cos4, baked = sensor(joint)
    near = kernel_at(setup)
    bent = arc_kernel(
        setup,
        make_scene(setup, scenes.pose((0, 0, 0), (0, 0, 0)), ground=SeamLine(0.0, 0.1, 0.0, 0.01, 0.0, 0.0)),
    )
    far_mm, aside_mm = 1.01 * REACH_MM, (N_LATERAL + 0.6) * STEP_MM
    e_x, e_y, e_z = near.eye
    for kernel in (
        near._replace(eye=(e_x + far_mm, e_y, e_z)),
        near._replace(eye=(e_x, e_y - far_mm, e_z)),
        near._replace(eye=(e_x, e_y, e_z + far_mm)),
        kernel_at(setup, (0.0, aside_mm, 0.0)),
        kernel_at(setup, level=1.01 * BRIGHTEST),
        bent,
    ):
        plain, made = map_of(kernel, xy, cos4, NOTHING_BAKED), map_of(kernel, xy, cos4, baked)
        assert not made.table.is_ready.any()
        np.testing.assert_array_equal(frame(made), frame(plain))
    assert map_of(near, xy, cos4, baked).table.is_ready.any()


def test_nothing_is_baked_of_a_corrugation():
    *_, baked = sensor("corrugation")
    assert len(baked.n_cells) == 0


def test_nothing_is_baked_that_takes_thousands_of_cells():
    """A camera right over the arc sees the spot below it, where light varies by the tenth of a millimetre."""
    over = scenes.camera(((4.0, 0.0, 120.0), (0.0, 0.0, 0.0)), width=160, height=120, focal_px=400.0)
    setup = scenes.setup("v_groove", of_camera=over)
    xy = Rays.of(setup.camera).xy.reshape(-1, 2)
    nominal = arc_kernel(setup, make_scene(setup, scenes.pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))))
    assert len(baked_light(nominal, xy, 120, TOLERANCE, QUARTER_DN_E).n_cells) == 0


@pytest.mark.parametrize("joint", ["v_groove", "lap"])
def test_a_pixels_light_does_not_depend_on_what_was_asked_before(joint):
    setup, xy, cos4, baked = sensor(joint)
    kernel, pixels = kernel_at(setup, (3.0, 0.33, 0.5), (1.0, -1.0, 0.5)), np.arange(0, 19_200, 131)
    first, later = (map_of(kernel, xy, cos4, baked) for _ in range(2))
    want = first.at(pixels)
    frame(later)
    np.testing.assert_array_equal(later.at(pixels), want)
    np.testing.assert_array_equal(frame(first), frame(later))


@pytest.mark.parametrize("joint", ["v_groove", "lap"])
def test_what_is_baked_spares_the_integrals_of_a_frame(joint):
    """Cells of a frame at a pose that no table was made for: all but a few are ready before it."""
    setup, xy, cos4, baked = sensor(joint)
    kernel = kernel_at(setup, (11.0, 0.27, 1.0), (1.0, 1.0, -1.0))
    plain, made = map_of(kernel, xy, cos4, NOTHING_BAKED), map_of(kernel, xy, cos4, baked)
    ready = int(made.table.n_cells[0])
    frame(plain)
    frame(made)
    assert int(made.table.n_cells[0]) - ready < 0.5 * int(plain.table.n_cells[0])
