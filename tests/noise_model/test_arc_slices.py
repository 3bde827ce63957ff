"""The arc's light over a lap whose edge is no straight line: upright slices against many rays."""

import math

import numba
import numpy as np
import pytest
import scenes
from hypothesis import example, given, settings
from hypothesis import strategies as st

from noise_model.arc.lap_light import lap_light
from noise_model.arc.map import arc_kernel
from noise_model.arc.quadrature import DiscRule, Patch, gauss_nodes
from noise_model.arc.ray import _light_of, light_at
from noise_model.arc.scene import make_scene
from noise_model.arc.scratch import ArcScratch
from noise_model.arc.slices import MAX_SLICES, N_NUMBERS, SlicedSheets
from noise_model.surface.brdf import Lobe, Material, lobe_numbers, reflectance
from noise_model.surface.visibility import first_crossing

RADIUS_MM = 3.0
N_AZIMUTHS, N_ELEVATIONS = 400, 200
MATERIALS = [
    Material("round", 0.4, 0.2, 8.0),
    Material("skewed", 0.4, 0.2, 8.0, Lobe(tail=0.3, anisotropy=0.2, marks_deg=30.0)),
]


def height_mm(x, sheets):
    """Return the corrugation's height at stations."""
    height, width, pitch = sheets.corrugation
    off = np.abs(x - pitch * np.round(x / pitch))
    return np.where(off < 0.5 * width, 0.5 * height * (1.0 + np.cos(2.0 * np.pi * off / width)), 0.0)


def first_way(over, across, bend, from_upper):
    """Return the first way on which rays come to the edge; see `visibility.first_crossing`."""
    return np.vectorize(first_crossing)(over, across, bend, from_upper)


def clearance(P, o, center, sheets):
    """Return by how much rays o (n, 3) from P that meet the arc pass over the metal, mm."""
    edge_y, slope, curve, step = sheets.edge
    to = center - P
    along = o @ to
    t_arc = along - np.sqrt(np.maximum(0.0, along * along - to @ to + RADIUS_MM**2))
    free = np.full(len(o), 1e9)
    if sheets.cut:
        x, y, z = P[:, np.newaxis] + t_arc * o.T
        beyond = y - edge_y - slope * (x - P[0]) - 0.5 * curve * (x - P[0]) ** 2
        free = z - height_mm(x, sheets) - np.where(beyond < 0.0, step, 0.0)
    if sheets.edge_hides:
        t = first_way(P[1] - edge_y, o[:, 1] - slope * o[:, 0], curve * o[:, 0] ** 2, sheets.from_upper)
        first, last = (np.zeros_like(t), np.minimum(t, t_arc)) if sheets.from_upper else (t, t_arc)
        meets = (t < t_arc) & ((t > 0.0) | (not sheets.from_upper))
        t_edge = np.where(meets, t, 0.0)
        at_edge = P[2] + t_edge * o[:, 2] - height_mm(P[0] + t_edge * o[:, 0], sheets) - step
        free = np.where(meets, np.minimum(free, at_edge), free)
        t_crest = (sheets.crest_x - P[0]) / o[:, 0]
        at_crest = P[2] + t_crest * o[:, 2] - height_mm(np.array(sheets.crest_x), sheets) - step
        free = np.where((first < t_crest) & (t_crest < last), np.minimum(free, at_crest), free)
    return free


def summed(P, normal, omega_r, center, planes, sheets, material, finer=1):
    """Return the light of many rays, and what it were without metal; even between tangents."""
    n_azimuths, n_elevations = finer * N_AZIMUTHS, finer * N_ELEVATIONS
    to = center - P
    plan, ahead = math.hypot(to[0], to[1]), math.atan2(to[1], to[0])
    # Between the tangents to the sphere in each upright plane, even in the angle across them.
    across = np.pi * (np.arange(n_azimuths) + 0.5) / n_azimuths
    offset, d_offset = RADIUS_MM * np.cos(across), RADIUS_MM * np.sin(across) * np.pi / n_azimuths
    phi, way = np.arcsin(offset / plan), np.sqrt(plan**2 - offset**2)
    rise = np.arctan2(to[2], way)
    half = np.arcsin(np.sqrt(RADIUS_MM**2 - offset**2) / np.hypot(way, to[2]))
    low, high = np.sin(np.maximum(rise - half, -np.pi / 2)), np.sin(np.minimum(rise + half, np.pi / 2))
    t = low + (np.arange(n_elevations)[:, np.newaxis] + 0.5) / n_elevations * (high - low)
    weight = np.broadcast_to((high - low) / n_elevations * d_offset / way, t.shape).ravel()
    level = np.sqrt(1.0 - t * t)
    o = np.stack([level * np.cos(ahead + phi), level * np.sin(ahead + phi), t], axis=-1).reshape(-1, 3)
    along = o @ to
    rest = along * along - to @ to + RADIUS_MM**2
    shines = (rest > 0.0) & ((along - np.sqrt(np.maximum(rest, 0.0))) * o[:, 2] >= to[2])
    o, weight = o[shines], weight[shines]
    kappas = material.kappa_diff, material.kappa_spec, material.c2
    shine = reflectance(o, omega_r, normal, *kappas, material.lobe) * np.maximum(0.0, o @ normal) * weight
    is_open = (o @ planes.T > 0.0).all(axis=1) & (clearance(P, o, center, sheets) >= 0.0)
    return shine[is_open].sum(), shine.sum()


def assert_rays_agree(way, over_mm, bend, ridge_mm, crest, horizon, flags, material, nodes, limit):
    """Hold the light by slices against many rays; it may be off by a share of the light without metal."""
    (cut, is_upright), (slope, curve) = flags, bend
    from_upper, step_mm = over_mm < 0.0, 1.5
    P = np.array([3.0, over_mm, 0.0 if not from_upper else step_mm])
    # The arc burns on a sheet, or a little above it.
    center = P + np.array([way[0], way[1], 0.0])
    beside_mm = center[1] - (slope + 0.5 * curve * way[0]) * way[0]
    center[2] = way[2] + (step_mm if beside_mm < 0.0 else 0.0)
    reaches = beside_mm + RADIUS_MM > 0.0 if from_upper else beside_mm - RADIUS_MM < 0.0
    edge_hides = bool(curve != 0.0 or reaches)
    sheets = SlicedSheets(
        (ridge_mm, 10.0, 20.0), (0.0, *bend, step_mm), P[0] + crest * way[0], edge_hides, cut, from_upper
    )
    P[2] += height_mm(P[:1], sheets)[0]
    center[2] += height_mm(center[:1], sheets)[0]
    if height_mm(np.array(sheets.crest_x), sheets) + step_mm > center[2]:
        # A crest past the arc's near side is no higher than the arc's foot; see `visibility.write_horizon`.
        sheets = sheets._replace(crest_x=min(sheets.crest_x, center[0] - RADIUS_MM))
    planes = np.array([[0.0, 0.0, 1.0], [-horizon, 0.0, 1.0]])
    if is_upright:
        planes = np.vstack([planes, [math.sin(crest), math.cos(crest), 0.0]])
    normal, omega_r = np.array([0.0, 0.0, 1.0]), np.array([0.6, 0.0, 0.8])
    got = lap_light(
        Patch(tuple(P), tuple(normal), tuple(omega_r)),
        tuple(center),
        RADIUS_MM,
        planes,
        len(planes),
        sheets,
        lobe_numbers(material),
        DiscRule(gauss_nodes(), *nodes),
        np.empty(N_NUMBERS * MAX_SLICES, dtype=np.float32),
    )
    want, whole = summed(P, normal, omega_r, center, planes, sheets, material)
    if abs(got - want) > limit * whole:
        # Near the arc so few rays may be 1.6 % off themselves.
        want, whole = summed(P, normal, omega_r, center, planes, sheets, material, finer=4)
    assert got == pytest.approx(want, abs=limit * whole)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@example(
    way=(38.0, 0.0, 0.0),
    over_mm=0.0,
    bend=(0.0, -0.004),
    ridge_mm=0.0,
    crest=0.5,
    horizon=0.0,
    flags=(False, False),
    material=MATERIALS[0],
)
@example(
    way=(4.0, -1.5, 1.5),
    over_mm=1.0,
    bend=(0.0, 0.0),
    ridge_mm=0.0,
    crest=0.5,
    horizon=0.0,
    flags=(False, False),
    material=MATERIALS[0],
)
@given(
    way=st.tuples(st.floats(4.0, 40.0), st.floats(-8.0, 8.0), st.floats(0.0, 1.5)),
    over_mm=st.one_of(st.just(0.0), st.floats(-4.0, -0.03), st.floats(0.03, 4.0)),
    bend=st.sampled_from([(0.0, 0.0), (0.1, 0.0), (0.05, 0.004), (0.0, -0.004)]),
    ridge_mm=st.sampled_from([0.0, 2.0]),
    crest=st.floats(0.1, 0.9),
    horizon=st.floats(-0.1, 0.1),
    flags=st.tuples(st.booleans(), st.booleans()),
    material=st.sampled_from(MATERIALS),
)
def test_slices_hold_the_light_of_many_rays(way, over_mm, bend, ridge_mm, crest, horizon, flags, material):
    scene = way, over_mm, bend, ridge_mm, crest, horizon, flags, material
    assert_rays_agree(*scene, nodes=(32, 16), limit=0.006)


@pytest.mark.slow
@pytest.mark.parametrize(("over_mm", "curve"), [(0.0, -0.004), (0.02, -0.004), (-0.03, 0.004)])
def test_slices_are_parted_at_the_tangent_of_an_edge_that_bends_away(over_mm, curve):
    for aside_mm in np.linspace(-3.0, 3.0, 25):
        scene = (20.0, aside_mm, 0.5), over_mm, (0.0, curve), 2.0, 0.8, 0.0, (False, False), MATERIALS[0]
        # As few slices as in the tracker: one of them is up to 2 / 32 of the light.
        assert_rays_agree(*scene, nodes=(8, 12), limit=0.002)


def test_the_integral_over_slices_is_in_kernels_of_laps_alone():
    for joint in ("v_groove", "lap"):
        setup = scenes.setup(joint)
        kernel = arc_kernel(setup, make_scene(setup, scenes.pose((0.0, 0.0, 0.0))))
        assert light_at(kernel, (0.0, -8.0, 0.0), 0, ArcScratch.of(kernel.vertices)) > 0.0
    called = {
        isinstance(types[-1], numba.types.Array): {callee.name for callee in made.library.relies_on}
        for types, made in _light_of.overloads.items()
    }
    assert ("_light_on_lap" in called[True], "_light_on_lap" in called[False]) == (True, False)
