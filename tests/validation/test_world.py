"""Frames of the independent renderer: noise, determinism, and where each hidden effect shows."""

import dataclasses

import numpy as np
import pytest
from worlds import ARC, BOTH, DARK, LASER, charge_of, moment_of, overfull_world, pose, studio_of, world_of

from noise_model.effects import REGISTRY
from validation.second_renderer.world import (
    FORMS,
    apply_moment_effects,
    apply_world_effects,
    form_of,
    in_order,
    read_out,
)
from validation.second_renderer.world_effect import CATALOGUE, HiddenEffect

pytestmark = pytest.mark.usefixtures("mitsuba")

LEVELS = {"dark": DARK, "laser": LASER, "arc": ARC}

SHOWS = {
    "arc": {
        *("arc_length", "arc_deflection", "arc_radius", "arc_flicker", "argon_line_leak"),
        *("spatter", "hot_metal_glow"),
    },
    "laser": {"laser_power_drift", "laser_speckle", "uneven_fan", "stripe_profile", "ghost_stripe"},
    "dark": {"black_level", "read_noise", "ambient_light", "image_compression"},
}
"""Effects that show with the arc alone, the laser alone, or all over; all others show with either light."""


def all_forms():
    return [(effect, form) for effect, forms in FORMS.items() for form in forms]


def hidden(effect, form=CATALOGUE, strength=1.0, seed=4, setup=None):
    setup = world_of(width=80).setup if setup is None else setup
    return HiddenEffect(effect, form, FORMS[effect][form].draw(np.random.default_rng(seed), strength, setup))


def test_it_has_the_catalogues_effects_and_another_form_of_most():
    # What diagnose does not look for, the blind check does not hide.
    assert set(FORMS) == set(REGISTRY) - {"spatter_streaks", "groove_glare", "mirrored_stripe"}
    assert all(next(iter(forms)) == CATALOGUE for forms in FORMS.values())
    assert sum(len(forms) > 1 for forms in FORMS.values()) >= 12


@pytest.fixture(scope="module")
def world():
    return overfull_world()


@pytest.fixture(scope="module")
def plain(world):
    studio = studio_of(world)
    return {name: charge_of(world, levels=levels, studio=studio) for name, levels in LEVELS.items()}


@pytest.mark.parametrize(("effect", "form"), all_forms())
def test_an_effect_shows_where_it_should_and_nowhere_else(world, plain, effect, form):
    acting = (hidden(effect, form, setup=world.setup),)
    studio = studio_of(apply_world_effects(world, acting))
    for name, levels in LEVELS.items():
        moment = moment_of(levels)
        charge = charge_of(world, acting, levels=levels, studio=studio)
        draws = np.random.default_rng(6), np.random.default_rng(6)
        frame = read_out(studio.world, acting, apply_moment_effects(moment, acting), charge, draws[0])
        stated = read_out(world, (), moment, plain[name], draws[1])
        changed = float(np.mean(frame != stated))
        expected = (
            effect in SHOWS["dark"]
            or (name == "arc" and effect in SHOWS["arc"])
            or (name == "laser" and effect in SHOWS["laser"])
            or (name != "dark" and not any(effect in shows for shows in SHOWS.values()))
        )
        if effect == "gamma" and name == "dark":
            # A bent response bends the noise about zero too, all but a knee's.
            expected = form != "knee"
        if effect == "blooming" and name == "arc":
            expected = plain["arc"].max() > world.setup.sensor.full_well_e
        assert (changed > 0.002) == expected, (name, changed)


@pytest.mark.parametrize("effect", ["gamma", "vignetting", "veiling_glare", "hand_eye", "fume", "arc_length"])
def test_strength_is_strength(world, plain, effect):
    def change(strength):
        acting = (hidden(effect, strength=strength),)
        charge = charge_of(world, acting, levels=ARC)
        noise = (np.random.default_rng(6) for _ in range(2))
        frame = read_out(world, acting, moment_of(ARC), charge, next(noise)).astype(float)
        return np.abs(frame - read_out(world, (), moment_of(ARC), plain["arc"], next(noise))).mean()

    assert change(1.0) > 1.7 * change(0.0)


def test_the_closed_forms_of_some_effects(world, plain):
    both = charge_of(world, levels=BOTH)
    np.testing.assert_allclose(both, plain["arc"] + plain["laser"], rtol=1e-6, atol=1e-3)
    glare = charge_of(world, (HiddenEffect("veiling_glare", CATALOGUE, {"share": 0.2}),), levels=ARC)
    assert glare.mean() == pytest.approx(plain["arc"].mean(), rel=1e-3)
    assert np.ptp(glare) == pytest.approx(0.8 * np.ptp(plain["arc"]), rel=1e-3)
    drift = HiddenEffect("laser_power_drift", CATALOGUE, {"rate_per_s": 0.1, "settle_s": 1e6})
    later = charge_of(world, (drift,), levels=LASER, time_s=2.0, T_base_tool=pose())
    np.testing.assert_allclose(later, np.exp(0.2) * plain["laser"], rtol=1e-4)
    lossy = charge_of(world, (HiddenEffect("vignetting", CATALOGUE, {"loss": 0.4}),), levels=ARC)
    middle = np.s_[29:31, 39:41]
    np.testing.assert_allclose(lossy[middle], plain["arc"][middle], rtol=2e-3)
    assert lossy[0, 0] == pytest.approx(0.6 * plain["arc"][0, 0], rel=0.03)


def test_blooming_spills_along_saturated_columns_alone(world):
    well = world.setup.sensor.full_well_e
    charge = np.full((40, 30), 100.0)
    charge[20, 7] = well + 1.0e5
    spilled = form_of(HiddenEffect("blooming", CATALOGUE)).charge(
        charge, world, {"spill": 0.5, "reach_px": 3.0}
    )
    beside = np.delete(spilled - charge, 7, axis=1)
    assert not beside.any()
    assert (spilled - charge)[:, 7].sum() == pytest.approx(5.0e4, rel=0.01)
    assert spilled[19, 7] > spilled[18, 7] > spilled[17, 7] > 100.0
    leaked = form_of(HiddenEffect("blooming", "leak")).charge(charge, world, {"leak": 0.2})
    np.testing.assert_allclose((leaked - charge)[:, 7], 0.2 * 1.0e5 / 40.0)


def test_noise_has_the_stated_moments_and_ends(world):
    sensor = world.setup.sensor
    charge = np.full((400, 500), 5000.0)
    frame = read_out(world, (), moment_of(), charge, np.random.default_rng(1)).astype(float)
    assert frame.mean() == pytest.approx(4.0 + 5000.0 / 80.0, abs=0.01)
    assert frame.var() == pytest.approx((5000.0 + 45.0**2) / 80.0**2 + 1.0 / 12.0, rel=0.01)
    full = read_out(world, (), moment_of(), np.full((9, 9), 1e5), np.random.default_rng(1))
    assert (full == 255).all()
    shallow = dataclasses.replace(world.setup, sensor=dataclasses.replace(sensor, full_well_e=8000.0))
    full = read_out(
        dataclasses.replace(world, setup=shallow),
        (),
        moment_of(),
        np.full((9, 9), 1e5),
        np.random.default_rng(1),
    )
    assert (full == 104).all()
    bent = (HiddenEffect("gamma", CATALOGUE, {"gamma": 0.5}),)
    frame = read_out(world, bent, moment_of(), np.full((400, 500), 5100.0), np.random.default_rng(1))
    assert frame.mean() == pytest.approx(4.0 + 255.0 * 0.5, abs=0.1)


def test_heavy_noise_has_the_variance_of_its_ratio(world):
    for form in FORMS["read_noise"]:
        acting = (HiddenEffect("read_noise", form, {"noise_ratio": 3.0}),)
        charge = np.full((600, 600), 2000.0)
        frame = read_out(world, acting, moment_of(), charge, np.random.default_rng(2)).astype(float)
        want = (2000.0 + (3.0 * 45.0) ** 2) / 80.0**2 + 1.0 / 12.0
        assert frame.var() == pytest.approx(want, rel=0.02)


def test_what_is_kept_on_disk_changes_nothing(world, tmp_path):
    fresh = charge_of(world, levels=ARC)
    first = charge_of(world, levels=ARC, studio=studio_of(world, tmp_path))
    kept = list(tmp_path.iterdir())
    again = charge_of(world, levels=ARC, studio=studio_of(world, tmp_path))
    assert len(kept) == 1
    assert list(tmp_path.iterdir()) == kept
    np.testing.assert_array_equal(fresh, first)
    np.testing.assert_array_equal(first, again)
    charge_of(world, levels=ARC, T_base_tool=pose((2.0, 0.6, 1.0)), studio=studio_of(world, tmp_path))
    assert len(list(tmp_path.iterdir())) == 2


def test_effects_act_in_the_order_of_the_stages():
    acting = [
        HiddenEffect("gamma", CATALOGUE),
        HiddenEffect("fume", "plume"),
        HiddenEffect("hand_eye", CATALOGUE),
    ]
    assert [one.id for _, one in in_order(acting)] == ["hand_eye", "fume", "gamma"]


def test_unknown_effects_and_forms_are_named():
    with pytest.raises(ValueError, match="effect 'gama' is not known"):
        form_of(HiddenEffect("gama", CATALOGUE))
    with pytest.raises(ValueError, match="hand_eye has no form 'other'"):
        form_of(HiddenEffect("hand_eye", "other"))
