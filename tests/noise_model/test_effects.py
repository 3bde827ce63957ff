"""The registry: what the contract names, limits, continuity, where effects act, and in which order."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import scenes
from effect_scenes import CONDITIONS, EXPOSURE_S, LATE_S, TURNED, affected, light_of, nominal, passed

from noise_model.condition import Condition
from noise_model.effects import (
    REGISTRY,
    Stage,
    apply_condition_effects,
    apply_setup_effects,
    checked,
    pose_time_s,
)
from noise_model.effects.effect import Effect
from noise_model.fit import Parameter
from noise_model.forward import FILL_TOLERANCE, Renderer, predict

CONTRACT = {
    "source": ["arc_length", "arc_deflection", "arc_radius", "arc_flicker", "argon_line_leak"],
    "illumination": [
        *("laser_power_drift", "laser_speckle", "uneven_fan", "stripe_profile", "ambient_light"),
    ],
    "surface": [
        *("wrong_material", "roughness_change", "brdf_tail", "rolling_marks", "plate_outline"),
        *("interreflection", "groove_glare", "mirrored_stripe"),
    ],
    "medium": ["fume", "spatter", "spatter_streaks", "hot_metal_glow"],
    "optics": ["veiling_glare", "defocus", "vignetting", "dirty_window", "filter_shift", "ghost_stripe"],
    "sensor": [
        *("gamma", "black_level", "blooming", "fixed_pattern", "read_noise", "exposure_drift"),
        "image_compression",
    ],
    "geometry": ["hand_eye", "surface_tilt", "lens_distortion"],
    "timing": ["pose_delay"],
}
STAGES = list(CONTRACT)
DRIFTS = ("rate_per_s", "swing_sin", "swing_cos")
AMPLITUDES = {
    "laser_speckle": ("contrast",),
    "spatter": ("rate_per_frame",),
    "spatter_streaks": ("rate_per_frame",),
    "groove_glare": ("peak_e",),
    "hot_metal_glow": ("peak_e",),
    "fume": ("extinction_per_m",),
    "blooming": ("spill", "column_share"),
    "rolling_marks": ("anisotropy",),
    "argon_line_leak": ("line_width_nm",),
    "laser_power_drift": DRIFTS,
    "exposure_drift": DRIFTS,
    "ambient_light": ("level_e",),
    "ghost_stripe": ("strength",),
}
"""The parameters that alone take an effect away, where others say only of what kind it is."""

WHERE = {
    "source": {"arc", "both"},
    "illumination": {"laser", "both"},
    "surface": {"laser", "arc", "both"},
    "fume": {"laser", "arc", "both"},
    "medium": {"arc", "both"},
    "optics": {"laser", "arc", "both"},
    "sensor": {"laser", "arc", "both"},
    "black_level": set(CONDITIONS),
    "read_noise": set(CONDITIONS),
    "ambient_light": set(CONDITIONS),
    "ghost_stripe": {"laser", "both"},
    "groove_glare": {"arc", "both"},
    "mirrored_stripe": {"laser", "both"},
    "image_compression": set(CONDITIONS),
    "geometry": {"laser", "arc", "both"},
    "timing": set(),
}
"""In which conditions an effect shows at its typical values: by its stage, or by its own name."""

HARDLY = {("filter_shift", "arc"), ("gamma", "dark")}
"""Where one acts and is hardly seen: the arc's continuum, and a power's noise about zero charge."""

every_effect = pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow) if name == "interreflection" else name for name in REGISTRY],
)


@pytest.fixture(scope="module")
def renderer():
    return Renderer()


@functools.cache
def renderer_apart(name):
    """A renderer of setups with one effect alone: several tests look at the same bounced light."""
    return Renderer()


def numbers(setup, condition, renderer=None):
    """All that is predicted, in one row: mean, sigma, modes."""
    got = predict(setup, TURNED, condition, renderer=renderer)
    rows = [got.mean_dn, np.sqrt(got.variance_dn2), *got.modes_e.values()]
    assert all(np.isfinite(row).all() for row in rows)
    return np.concatenate([row.ravel() for row in rows])


def test_the_contracts_effects_are_there_and_in_their_stages():
    wanted = {name: stage for stage, names in CONTRACT.items() for name in names}
    assert len(wanted) == 39
    assert set(wanted) == set(REGISTRY)
    for name, effect in REGISTRY.items():
        assert effect.id == name
        assert effect.stage.value == wanted[name]


def test_they_act_in_the_order_that_light_takes():
    order = [STAGES.index(effect.stage.value) for effect in REGISTRY.values()]
    assert order == sorted(order)
    assert [stage.value for stage in Stage] == STAGES
    names = list(REGISTRY)
    # What glows does so behind the fume, and the window stands before the lens.
    for first, second in (
        ("hot_metal_glow", "fume"),
        ("spatter", "fume"),
        ("dirty_window", "vignetting"),
        ("vignetting", "veiling_glare"),
        ("fixed_pattern", "blooming"),
    ):
        assert names.index(first) < names.index(second)


@every_effect
def test_an_effect_says_what_it_is(name):
    effect = REGISTRY[name]
    for text in (effect.summary, effect.equation, effect.source):
        assert len(text) > 3
        assert "TODO" not in text
    assert effect.parameters
    for parameter in effect.parameters:
        assert parameter.name.isidentifier()
        assert math.isfinite(parameter.prior_sigma)
        assert math.isfinite(parameter.lower)
        assert math.isfinite(parameter.upper)
        # A step is a small share of what is expected, and an expected value lies between the bounds.
        assert parameter.step <= 0.2 * parameter.prior_sigma
        assert parameter.prior_sigma <= parameter.upper - parameter.lower
        for unit in ("mm", "px", "deg", "nm", "s", "e", "dn", "per_s", "per_m"):
            if parameter.name.endswith(f"_{unit}") and not parameter.name.endswith(f"_per_{unit}"):
                expected = {"e": "e-", "dn": "DN", "per_s": "1/s", "per_m": "1/m"}.get(unit, unit)
                assert parameter.unit == expected
        # What is shown as typical is not far out in the prior.
        typical = effect.typical.get(parameter.name, parameter.start)
        assert abs(typical - parameter.start) <= 2.0 * parameter.prior_sigma
    assert effect.typical
    assert effect.complete(effect.typical) != effect.neutral
    assert effect.complete({}) == effect.neutral


def test_wrong_names_and_values_are_refused():
    with pytest.raises(ValueError, match=r"\[effects.gama\]: there is no such effect; did you mean 'gamma'"):
        checked({"gama": {}})
    with pytest.raises(ValueError, match="there is no such effect; there are arc_length, "):
        checked({"xyz": {}})
    with pytest.raises(
        ValueError, match=r"\[effects.gamma\] gama: is no parameter of it; did you mean 'gamma'"
    ):
        checked({"gamma": {"gama": 1.0}})
    for value in (-1.0, 100.0, math.nan, math.inf):
        with pytest.raises(ValueError, match=r"\[effects.gamma\] gamma = .*: must lie from 0.2 to 5"):
            checked({"gamma": {"gamma": value}})
    with pytest.raises(ValueError, match=r"must lie from .* deg"):
        checked({"surface_tilt": {"roll_deg": 90.0}})


def test_checked_completes_and_orders():
    got = checked({"gamma": {}, "arc_deflection": {"y_mm": 1}})
    assert list(got) == ["arc_deflection", "gamma"]
    assert got == {"arc_deflection": {"x_mm": 0.0, "y_mm": 1.0}, "gamma": {"gamma": 1.0, "bend": 0.0}}


def test_an_effect_that_does_not_fit_is_refused():
    parameter = Parameter("a", "", 0.0, 1.0, -1.0, 1.0, 0.1)
    gamma = REGISTRY["gamma"]
    with pytest.raises(ValueError, match="names"):
        dataclasses.replace(gamma, parameters=(parameter, parameter), typical={})
    with pytest.raises(ValueError, match="names"):
        dataclasses.replace(gamma, parameters=(parameter,), typical={"b": 1.0})
    with pytest.raises(ValueError, match="acts nowhere else"):
        Effect("x", Stage.SENSOR, "", "", "", (parameter,), {}, setup=gamma.setup, light=lambda *_: None)


def test_what_changes_the_setup_changes_it_once():
    """And what acts on levels, light, image or clock stays listed."""
    setup = affected(nominal(), **{name: effect.typical for name, effect in REGISTRY.items()})
    once = apply_setup_effects(setup)
    twice = apply_setup_effects(once)
    assert once.effects == twice.effects
    assert set(once.effects) == {name for name, effect in REGISTRY.items() if effect.setup is None}
    assert once.arc == twice.arc
    assert once.material == twice.material
    assert once.sensor == twice.sensor
    np.testing.assert_array_equal(once.camera.T_tool_camera, twice.camera.T_tool_camera)
    assert once.sensor.gamma == pytest.approx(0.7)
    both = CONDITIONS["both"]
    assert apply_condition_effects(once, both) == apply_condition_effects(setup, both)


@every_effect
def test_at_its_neutral_values_an_effect_is_not_there(name, renderer):
    setup = nominal()
    neutral = affected(setup, **{name: {}})
    for condition in CONDITIONS.values():
        wanted = numbers(setup, condition, renderer)
        got = numbers(neutral, condition, renderer)
        np.testing.assert_allclose(got[: len(wanted)], wanted, rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(got[len(wanted) :], 0.0)


@pytest.mark.parametrize("name", AMPLITUDES)
def test_its_amplitudes_alone_take_an_effect_away(name, renderer):
    """Whatever the others are."""
    setup, effect = nominal(), REGISTRY[name]
    values = {p.name: min(p.upper, p.start + 2.0 * p.prior_sigma) for p in effect.parameters}
    values.update((amplitude, effect.neutral[amplitude]) for amplitude in AMPLITUDES[name])
    for condition in CONDITIONS.values():
        np.testing.assert_allclose(
            numbers(affected(setup, **{name: values}), condition, renderer),
            numbers(setup, condition, renderer),
            rtol=1e-5,
            atol=1e-4,
        )


@every_effect
def test_a_small_step_changes_little_and_in_proportion(name, renderer):
    """The step is the one that derivatives are taken with; a variance goes with the square of a sigma."""
    # A plate's edges are far away at first.
    if name in ("pose_delay", "plate_outline"):
        return
    # Bright enough to bloom, on a plate without edges; on a plate nothing bounces.
    joint = "v_groove" if name in ("interreflection", "mirrored_stripe") else "flat"
    setup, bright = nominal(joint), Condition(1.0, 1.0, 4.0 * EXPOSURE_S, LATE_S)
    at_rest = numbers(setup, bright, renderer)
    apart = renderer_apart(name)
    moved = 0
    for parameter in REGISTRY[name].parameters:
        change = []
        for share in (2.0, 1.0):
            # From its upper bound a value can only fall.
            step = -parameter.step if parameter.start == parameter.upper else parameter.step
            values = {parameter.name: parameter.start + share * step}
            got = numbers(affected(setup, **{name: values}), bright, apart)
            change.append(got - np.pad(at_rest, (0, len(got) - len(at_rest))))
        size = [float(np.linalg.norm(row)) for row in change]
        assert np.sqrt(np.mean(change[1][: len(at_rest) // 2] ** 2)) < 5.0
        if size[1] > 1e-3:
            moved += 1
            assert 1.3 < size[0] / size[1] < 4.6
    assert moved


@every_effect
def test_typical_values_show_where_they_should_and_nowhere_else(name, renderer):
    setup = nominal(full_well_e=3000.0 if name == "blooming" else 20400.0)
    typical, apart = affected(setup, **{name: REGISTRY[name].typical}), renderer_apart(name)
    for which, condition in CONDITIONS.items():
        before = predict(setup, TURNED, condition, renderer=renderer)
        after = predict(typical, TURNED, condition, renderer=apart)
        if (name, which) in HARDLY:
            continue
        if which in WHERE.get(name, WHERE[REGISTRY[name].stage.value]):
            sigma = np.sqrt(before.variance_dn2)
            seen = np.percentile(np.abs(after.mean_dn - before.mean_dn) / sigma, 99)
            noisier = np.percentile(np.abs(after.variance_dn2 / before.variance_dn2 - 1.0), 99)
            together = max((float(np.max(mode)) for mode in after.modes_e.values()), default=0.0)
            assert max(seen, noisier, together / 100.0) > 0.15, (which, seen, noisier, together)
        else:
            np.testing.assert_array_equal(after.mean_dn, before.mean_dn)
            np.testing.assert_array_equal(after.variance_dn2, before.variance_dn2)
            assert all(not mode.any() for mode in after.modes_e.values())


@every_effect
def test_bounds_can_be_predicted(name):
    """No number that is not finite, no negative variance, at either end of each parameter."""
    setup, effect, renderer = nominal(width=24, height=18), REGISTRY[name], Renderer()
    if name == "interreflection":
        setup, renderer = nominal(), renderer_apart(name)
    for parameter in effect.parameters:
        for value in (parameter.lower, parameter.upper):
            typical = {**effect.typical, parameter.name: value}
            got = predict(affected(setup, **{name: typical}), TURNED, CONDITIONS["both"], renderer=renderer)
            for image in (got.mean_e, got.variance_e2, got.mean_dn, got.variance_dn2):
                assert np.isfinite(image).all(), (parameter.name, value)
            assert (got.mean_e >= 0.0).all()
            assert (got.variance_dn2 > 0.0).all()


def test_glare_comes_after_vignetting():
    rng = np.random.default_rng(5)
    setup = nominal(psf_sigma_px=0.0)
    image = rng.uniform(0.0, 5000.0, (60, 80))
    got = passed(affected(setup, vignetting={"loss": 0.4}, veiling_glare={"share": 0.2}), light_of(image)).arc
    v, u = np.mgrid[:60, :80]
    dimmed = image * (1.0 - 0.4 * ((u - 39.5) ** 2 + (v - 29.5) ** 2) / (40.0**2 + 30.0**2))
    np.testing.assert_allclose(got, 0.8 * dimmed + 0.2 * dimmed.mean(), rtol=1e-5)


def test_the_fume_dims_what_glows():
    setup = nominal("flat", psf_sigma_px=0.0)
    glow = {"peak_e": 20000.0, "length_mm": 20.0}
    condition = CONDITIONS["arc"]
    dark = light_of(np.zeros((60, 80)))
    alone = passed(affected(setup, hot_metal_glow=glow), dark, condition).other
    dark = light_of(np.zeros((60, 80)))
    in_fume = affected(setup, hot_metal_glow=glow, fume={"extinction_per_m": 3.0, "scatter": 0.0})
    behind = passed(in_fume, dark, condition).other
    # 130 to 160 mm of it.
    assert (behind < 0.70 * alone).all()
    assert (behind > 0.60 * alone).all()


def test_the_exposure_acts_on_light_and_not_on_the_chip():
    """An effect behind the exposure sees the charge that is there."""
    setup = nominal("flat", psf_sigma_px=0.0, full_well_e=10_000.0)
    image = np.zeros((60, 80))
    image[30, 40] = 8000.0
    blooming = affected(setup, blooming={"spill": 1.0})
    assert not passed(blooming, light_of(image)).other.any()
    twice = Condition(1.0, 1.0, 2.0 * EXPOSURE_S)
    assert passed(blooming, light_of(image), twice).other.sum() == pytest.approx(6000.0, rel=0.5)


@every_effect
def test_some_pixels_are_those_of_the_frame(name):
    """Where neither neighbours nor the image's mean come in."""
    if name in (
        *("blooming", "veiling_glare", "dirty_window", "defocus", "spatter", "ghost_stripe"),
        "image_compression",
    ):
        return
    setup = affected(nominal("lap", psf_sigma_px=0.0), **{name: REGISTRY[name].typical})
    pixels = np.arange(5, 80 * 60, 37)
    whole = predict(setup, TURNED, CONDITIONS["both"])
    some = predict(setup, TURNED, CONDITIONS["both"], pixels=pixels)
    # Bounced light is interpolated between points that are spread over what the pixels show; a whole frame's
    # arc map is filled.
    rtol = 0.02 if name == "interreflection" else 3.0 * FILL_TOLERANCE
    np.testing.assert_allclose(some.mean_e, whole.mean_e.ravel()[pixels], rtol=rtol, atol=1e-3)
    # Near the end of the scale a DN's variance falls to nothing within one sigma of the mean.
    below = some.mean_e < 0.95 * setup.sensor.full_well_e
    variance = whole.variance_dn2.ravel()[pixels]
    np.testing.assert_allclose(some.variance_dn2[below], variance[below], rtol=rtol, atol=1e-3)
    assert below.mean() > 0.5


def test_spread_light_of_some_pixels_is_that_of_their_own_mean():
    """An even sample's, and of the whole frame within what its sampling leaves."""
    setup = affected(nominal("flat", psf_sigma_px=0.0), veiling_glare={"share": 0.5})
    even = np.arange(60 * 80).reshape(60, 80)[2::4, 2::4].ravel()
    whole = predict(setup, TURNED, CONDITIONS["arc"]).mean_e.ravel()[even]
    some = predict(setup, TURNED, CONDITIONS["arc"], pixels=even).mean_e
    np.testing.assert_allclose(some, whole, rtol=0.03)


@every_effect
def test_past_the_workpiece_and_without_light_all_is_finite(name):
    over_the_edge = scenes.camera(((0.0, 0.0, 60.0), (60.0, 0.0, 57.0)), width=40, height=30)
    setup = dataclasses.replace(nominal("lap"), camera=over_the_edge)
    setup = affected(setup, **{name: REGISTRY[name].typical})
    for condition in (CONDITIONS["dark"], CONDITIONS["arc"]):
        got = predict(setup, scenes.pose(), condition)
        assert np.isfinite(got.mean_dn).all()
        assert np.isfinite(got.variance_dn2).all()
        assert (got.mean_e >= 0.0).all()


def test_a_remembered_pose_serves_another_sensor():
    """Full well and point-spread function are those of the setup that asks, not of the one that rendered."""
    renderer = Renderer()
    spatter = {"rate_per_frame": 20.0}
    wide, narrow = nominal(psf_sigma_px=4.0), nominal(psf_sigma_px=0.0)
    predict(affected(wide, spatter=spatter), TURNED, CONDITIONS["arc"], renderer=renderer)
    for condition, name, values, other in (
        ("arc", "spatter", spatter, narrow),
        ("both", "blooming", {"spill": 0.9}, nominal(full_well_e=5000.0)),
    ):
        setup = affected(other, **{name: values})
        got = predict(setup, TURNED, CONDITIONS[condition], renderer=renderer)
        wanted = predict(setup, TURNED, CONDITIONS[condition])
        np.testing.assert_array_equal(got.mean_dn, wanted.mean_dn)
        np.testing.assert_array_equal(got.variance_dn2, wanted.variance_dn2)


def test_a_delayed_pose_is_stamped_later():
    assert pose_time_s(nominal(), 3.0) == 3.0
    assert pose_time_s(affected(nominal(), pose_delay={"delay_s": 0.05}), 3.0) == pytest.approx(3.05)
