"""A seam that bends, as straight stretches."""

import numpy as np
import pytest
import scenes

from arctrack.nominal import nominal_setup
from noise_model.arc.map import arc_kernel
from noise_model.arc.ray import light_at
from noise_model.arc.scene import make_scene
from noise_model.arc.scratch import ArcScratch
from noise_model.forward import Renderer
from noise_model.surface.faces import face_normal
from noise_model.surface.joint import BentSeam, SeamLine, corrugation_height, section
from noise_model.transforms import moved

POSE = np.eye(4)
SETUP = nominal_setup("v_groove", "mild_steel", width=64, height=48)


def at(station_mm, slope_y=0.02):
    """A tangent of the same straight line: y = 0.3 + slope_y x."""
    return SeamLine(station_mm, 0.3 + slope_y * station_mm, 0.1, slope_y, 0.0)


def layers(seam, setup=SETUP):
    return Renderer().layers(setup, POSE, seam)


# Ridges do not turn with a seam, so stretches of a corrugated one that is inclined begin beside each other.
@pytest.mark.parametrize(("joint", "slope_y"), [("v_groove", 0.02), ("lap", 0.02), ("corrugation", 0.0)])
def test_stretches_of_a_straight_seam_are_that_seam(joint, slope_y):
    setup = nominal_setup(joint, "mild_steel", width=64, height=48)
    whole = layers(at(35.0, slope_y), setup)
    stretches = tuple(at(x, slope_y) for x in (25.0, 31.0, 38.0, 46.0))
    pieces = layers(BentSeam(stretches, at(35.0, slope_y)), setup)
    np.testing.assert_allclose(pieces.arc_e, whole.arc_e, atol=5e-3 * whole.arc_e.max())
    np.testing.assert_allclose(pieces.laser_e, whole.laser_e, atol=1e-4 * whole.laser_e.max())
    assert whole.arc_e.max() > 0.0
    assert whole.laser_e.max() > 0.0


def test_each_stretch_is_seen_where_it_lies():
    left, right = SeamLine(25.0, -1.0), SeamLine(45.0, 1.0)
    bent = layers(BentSeam((left, right), SeamLine()))
    x = bent.view.surface[0][..., 0]
    # Beside the other stretch a pixel's neighbour is seen elsewhere.
    for line, where in ((left, x < 33.0), (right, x > 37.0)):
        alone = layers(line)
        np.testing.assert_array_equal(bent.laser_e[where], alone.laser_e[where])


def test_the_arc_stands_on_the_ground_that_is_named():
    lap = nominal_setup("lap", "mild_steel", width=64, height=48)
    line = SeamLine(35.0)
    low, high = (layers(BentSeam((line,), SeamLine(0.0, 0.0, z)), lap) for z in (0.0, 1.0))
    assert high.view.scene.center_mm[2] - low.view.scene.center_mm[2] == pytest.approx(1.0)
    assert not np.allclose(low.arc_e, high.arc_e)


@pytest.mark.parametrize("x_mm", [-9.0, 0.0, 6.0, 14.0])
def test_the_arc_keeps_its_height_upright_over_ridges_that_lean(x_mm):
    """An inclined sheet's ridges lean with it, and the way down from the torch does not."""
    setup, rise = nominal_setup("corrugation", "zn_coated", width=160, height=120), 0.05
    line = SeamLine(0.0, slope_z=rise)
    T_base_tool = moved(np.eye(4), (0.0, -3.0, 0.0), (x_mm, 0.5, 9.0))
    center = line.frame() @ np.append(make_scene(setup, T_base_tool, line).center_mm, 1.0)
    offset = np.append(setup.arc.center_in_tool_mm, 1.0)
    np.testing.assert_allclose(center[:2], (T_base_tool @ offset)[:2], atol=1e-2)
    s = np.linspace(-40.0, 40.0, 80_001)
    c = corrugation_height(s, section(setup.joint).corrugation)
    x, z = (s - rise * c) / np.hypot(1.0, rise), (rise * s + c) / np.hypot(1.0, rise)
    assert center[2] - np.interp(center[0], x, z) == pytest.approx(offset[2], abs=5e-3)


def test_a_tangent_that_passes_the_torch_where_the_seam_does_is_the_seam():
    lap = nominal_setup("lap", "mild_steel", width=64, height=48)
    line = SeamLine(35.0, 0.0, 0.0, 0.02)
    whole = layers(line, lap).arc_e
    straight = layers(BentSeam((line,), SeamLine(0.0, -0.7)), lap).arc_e
    np.testing.assert_allclose(straight, whole, rtol=1e-3, atol=1e-3 * whole.max())


def test_ridges_stay_across_the_nominal_line_when_the_seam_turns():
    setup = nominal_setup("corrugation", "mild_steel", width=64, height=48)
    points, normals, _ = layers(SeamLine(35.0, 0.0, 0.0, 0.03), setup).view.surface
    seen = np.isfinite(points[..., 0])
    expected = corrugation_height(points[seen][:, 0], section(setup.joint).corrugation)
    sheet = np.where(points[seen][:, 1] < 0.0, setup.joint.dimensions["thickness_mm"], 0.0)
    on_sheet = np.abs(normals[seen][:, 1]) < 0.5
    np.testing.assert_allclose((points[seen][:, 2] - sheet)[on_sheet], expected[on_sheet], atol=1e-6)


def light_past_bent_edges(joint, P, normal, omega_r, center, material, slope, curve):
    """`scenes.arc_light`, its ways to the arc followed step by step over the section as it bends."""
    on_arc, omega_i, weight = scenes.arc_nodes(P, np.array(center), 3.0)
    seen = omega_i @ normal > 0.0
    on_arc, omega_i, weight = on_arc[seen], omega_i[seen], weight[seen]
    free = np.ones(len(on_arc), dtype=bool)
    for share in (np.arange(1000) + 0.5) / 1000:
        way = P + share * (on_arc - P)
        ahead = way[:, 0] - P[0]
        beside = slope * ahead + 0.5 * curve * ahead**2
        free &= way[:, 2] > scenes.height(joint, way[:, 0], way[:, 1] - beside) - 1e-3
    omega_i, weight = omega_i[free], weight[free]
    return float(np.sum(scenes.f_r(omega_i, omega_r, normal, material) * (omega_i @ normal) * weight))


@pytest.mark.slow
@pytest.mark.parametrize("bend_mm", [(0.0, -1.9), (0.0, 1.2), (0.03, 0.4), (0.0, 0.0)])
@pytest.mark.parametrize(("name", "y_mm"), [("lap", 0.5), ("lap", 2.0), ("lap", -2.0), ("corrugation", 1.0)])
def test_a_bent_edge_hides_the_arc_way_by_way(name, y_mm, bend_mm):
    setup = scenes.setup(name, "zn_coated", arc_center_mm=(0.0, 0.0, 2.0))
    view = make_scene(setup, scenes.pose((0.0, -0.6, 0.0)))._replace(bend=bend_mm)
    kernel = arc_kernel(setup, view, nodes=(24, 8))
    face = 0 if y_mm < 0.0 else 2
    x = 38.0
    z = float(scenes.height(setup.joint, x, y_mm))
    P, normal = (x, y_mm, z), np.array(face_normal(face, x, view.shape.vertices, view.shape.corrugation))
    omega_r = np.array(kernel.eye) - P
    omega_r /= np.linalg.norm(omega_r)
    way = view.center_mm[0] - x
    slope, curve = bend_mm[0], 2.0 * (bend_mm[1] - bend_mm[0] * way) / way**2
    want = light_past_bent_edges(
        setup.joint, np.array(P), normal, omega_r, view.center_mm, setup.material, slope, curve
    )
    got = light_at(kernel, P, face, ArcScratch.of(kernel.vertices)) / kernel.radiance_e
    assert got == pytest.approx(want, rel=0.02)


def test_stretches_out_of_order_are_refused():
    with pytest.raises(ValueError, match="rising order"):
        BentSeam((at(30.0), at(20.0)), SeamLine())
    with pytest.raises(ValueError, match="rising order"):
        BentSeam((), SeamLine())
