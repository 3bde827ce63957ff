"""The model held against a recording: derivatives foretell small moves, and edges do not count."""

import math
from dataclasses import replace

import numpy as np
import pytest

from noise_model.effects import REGISTRY, apply_setup_effects
from noise_model.forward import look
from noise_model.surface.joint import BentSeam, SeamLine
from sim_to_real.data.binned import observe, stated_condition
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.nuisances import N_LEVELS, SEAM_FROM, apply_nuisances
from sim_to_real.fit.tangents import EDGE_E, EDGE_SHARE
from tests.sim_to_real.small import held_against, of_stratum, recorded, small_recording
from tracker.state import Frame


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    return small_recording(tmp_path_factory.mktemp("expected") / "recording", {})


def test_derivatives_foretell_what_is_rendered_after_a_small_move(expected):
    # Of the arc: a coarse bin's blur spreads a stripe, which derivatives of what is rendered do not know.
    arc = of_stratum(expected, "arc")
    place = arc.neutral.copy()
    place[N_LEVELS:SEAM_FROM] = 0.02, -0.02, 0.03, 0.03, -0.03, 0.02
    here = arc.lights(arc.neutral, {})
    followed = arc.residuals(
        [arc.extrapolate(frame, light, place) for frame, light in zip(arc.observed.frames, here, strict=True)]
    )
    rendered, stayed = arc.residuals(arc.lights(place, {})), arc.residuals(here)
    moved, missed = np.abs(rendered - stayed), np.abs(rendered - followed)
    assert np.percentile(moved, 90) > 0.1
    assert np.percentile(missed, 90) < 0.1 * np.percentile(moved, 90)


def test_no_derivative_is_that_of_an_edge(expected):
    steps = np.array([[nuisance.step] for nuisance in expected.nuisances[N_LEVELS:SEAM_FROM]])
    for frame, tangents in zip(expected.observed.frames, expected._tangents, strict=True):
        if tangents.by_camera.laser_e is not None and frame.condition.arc_level == 0.0:
            light = expected.lights(expected.neutral, {})[frame.position].laser_e
            by_step = np.abs(tangents.by_camera.laser_e) * steps
            assert (by_step <= 2.0 * EDGE_SHARE * light + 2.0 * EDGE_E).all()


def test_a_camera_that_moves_takes_along_what_it_saw_of_the_seam(tmp_path):
    setup, frames, pose_at = recorded(tmp_path / "recording", {}, coarser=2)
    observed = observe(setup, frames, pose_at)
    model = LinearizedModel(observed)
    moved = model.neutral.copy()
    moved[N_LEVELS:SEAM_FROM] = 0.1, -0.1, 0.1, 0.2, 0.1, -0.1

    def off_mm(seen_by, course_of):
        stations, y_z = observed.seam_observations.in_joint(apply_nuisances(setup, seen_by))
        curve = model.renderings.seam_curve({})
        course = curve.evaluate(course_of[N_LEVELS:])[0]
        return np.abs([np.interp(stations, curve.stations_mm, of_axis) for of_axis in course] - y_z.T).max()

    assert off_mm(moved, moved) < off_mm(model.neutral, model.neutral) + 0.01
    assert off_mm(moved, model.neutral) > 0.1


def test_the_arc_s_light_is_uncertain_only_past_edges_that_bend(tmp_path):
    setup, frames, pose_at = recorded(tmp_path / "recording", {})
    lap = held_against(
        replace(setup, joint=replace(setup.joint, type="lap", dimensions={"thickness_mm": 3.0})),
        frames,
        pose_at,
    )
    straight, bent = lap.neutral, lap.neutral.copy()
    bent[SEAM_FROM + 2] = 2.0
    frame = next(frame for frame in lap.observed.frames if frame.stratum == "arc")
    assert not lap.bend_spread_e(frame, frame.bins, straight, {}).any()
    assert lap.bend_spread_e(frame, frame.bins, bent, {}).max() > 0.0


def test_bins_whose_neighbours_show_another_face_are_left_out(tmp_path):
    expected = small_recording(tmp_path / "recording", {})
    # The seam is moved to the side: edges lie where no mask has left them out.
    aside = expected.neutral.copy()
    aside[SEAM_FROM] = 3.0
    expected.mask_edges(aside, {})
    n_out = 0
    for frame in expected.observed.frames:
        setup = apply_setup_effects(expected.observed.binned)
        seam = expected.renderings.seam(frame, aside, {})
        rays = expected.renderings.rays_of(setup.camera)
        faces = look(setup, frame.T_base_tool_in(setup), seam, rays).faces
        for (row, column), sigma in zip(np.argwhere(frame.keep), frame.sigma_dn, strict=True):
            if 1 < row < len(faces) - 2 and 1 < column < faces.shape[1] - 2:
                shown = np.unique(faces[row - 2 : row + 3, column - 2 : column + 3])
                assert np.isinf(sigma) == (len(shown) > 1)
                n_out += int(np.isinf(sigma))
    assert n_out > 0


def test_each_pixel_shows_the_face_of_its_own_stretch(expected):
    frame, setup = expected.observed.frames[0], apply_setup_effects(expected.observed.binned)
    first, last, torch = frame.stations_mm
    middle = 0.5 * (first + last)
    lines = (SeamLine(0.5 * (first + middle), -1.5), SeamLine(0.5 * (middle + last), 1.5))
    seam, rays = BentSeam(lines, SeamLine(torch)), expected.renderings.rays_of(setup.camera)
    pose = frame.T_base_tool_in(setup)
    layers = look(setup, pose, seam, rays)
    alone = [look(setup, pose, line, rays).faces for line in lines]
    assert (layers.faces != alone[0]).any()
    assert (layers.faces != alone[1]).any()
    assert ((layers.faces == alone[0]) | (layers.faces == alone[1])).all()
    for n in (0, 1):
        stretch = np.full(layers.faces.size, n)
        all_pixels = np.arange(layers.faces.size)
        told = look(setup, pose, seam, rays, all_pixels, stretch)
        np.testing.assert_array_equal(told.faces.reshape(alone[n].shape), alone[n])


def test_a_long_exposure_does_not_cut_derivatives_off(expected):
    """The slopes of what is eight times as bright are eight times as large."""
    frames = [frame for frame in expected.observed.frames if frame.stratum == "laser"]
    laser = of_stratum(expected, "laser")
    longer = [
        replace(frame, condition=replace(frame.condition, exposure_s=8.0 * frame.condition.exposure_s))
        for frame in laser.observed.frames
    ]
    long = LinearizedModel(replace(laser.observed, frames=tuple(longer)))
    assert len(frames) == len(longer)
    for item, other in zip(laser.lights(laser.neutral, {}), long.lights(long.neutral, {}), strict=True):
        np.testing.assert_allclose(other.laser_factor, 8.0 * item.laser_factor, rtol=1e-5)
        assert other.laser_factor.max() > 4.0


@pytest.mark.parametrize(("current_a", "level"), [(math.nan, 1.0), (0.0, 0.0)])
def test_an_arc_of_unknown_current_is_on(expected, current_a, level):
    setup = expected.observed.setup
    frame = Frame(0, 0.0, expected.observed.frames[0].image_dn, 0.005, current_a, False, True)
    assert stated_condition(setup, frame, 0.0).arc_level == level


@pytest.mark.parametrize(
    ("effect", "values"),
    [
        ("roughness_change", {"c2_ln": 0.4}),
        ("wrong_material", {"kappa_diff_ln": 0.5}),
        ("rolling_marks", {"anisotropy": 0.4}),
        ("arc_length", {"height_mm": 0.5}),
        ("stripe_profile", {"width_ratio": 1.2}),
    ],
)
def test_what_is_remembered_of_other_effects_does_not_change_light(tmp_path, effect, values):
    """Rays meet the same under another metal, and the arc does not change the stripe."""
    fresh, used = (small_recording(tmp_path / name, {}) for name in ("fresh", "used"))
    for other in ({}, {"brdf_tail": {"tail": 0.3}}, {"arc_radius": {"radius_ratio": 1.2}}):
        used.lights(used.neutral, other)
    effects = {effect: REGISTRY[effect].complete(values)}
    plain = used.lights(used.neutral, {})
    moved = False
    for before, here, there in zip(
        plain, fresh.lights(fresh.neutral, effects), used.lights(used.neutral, effects), strict=True
    ):
        np.testing.assert_array_equal(here.arc_e, there.arc_e)
        np.testing.assert_array_equal(here.laser_e, there.laser_e)
        moved |= bool((here.arc_e != before.arc_e).any() or (here.laser_e != before.laser_e).any())
    assert moved


@pytest.mark.parametrize("name", [name for name, effect in REGISTRY.items() if not effect.spreads])
def test_bins_alone_show_what_they_show_in_a_whole_frame(expected, name):
    effects = {name: REGISTRY[name].complete(REGISTRY[name].typical)}
    alone = expected.lights(expected.neutral, effects)
    # A second stripe of no strength changes no light. As it may spread, the whole frame is predicted.
    assert REGISTRY["ghost_stripe"].spreads
    whole = expected.lights(expected.neutral, {**effects, "ghost_stripe": REGISTRY["ghost_stripe"].neutral})
    for light, in_frame in zip(alone, whole, strict=True):
        for source in ("arc_e", "laser_e", "other_e", "arc_factor", "laser_factor"):
            want = getattr(in_frame, source)
            np.testing.assert_allclose(
                getattr(light, source), want, rtol=1e-4, atol=1e-4 * want.max(initial=1.0)
            )
    assert any((light.arc_e > 0.0).any() for light in alone)


@pytest.mark.parametrize(
    "name", ["exposure_drift", "hand_eye", "gamma", "wrong_material", "fume", "dirty_window", "ghost_stripe"]
)
def test_residuals_alone_are_those_of_the_light(expected, name):
    """Of frames all together, of frames one by one, and of whole frames; levels are off nominal."""
    effects = {name: REGISTRY[name].complete(REGISTRY[name].typical)}
    place = expected.neutral.copy()
    place[0], place[1], place[2] = 0.1, -0.1, 0.2
    want = expected.residuals(expected.lights(place, effects))
    np.testing.assert_allclose(expected.residuals_at(place, effects), want, atol=1e-3)
    assert np.abs(want - expected.residuals(expected.lights(place, {}))).max() > 0.1
