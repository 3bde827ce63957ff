"""What scatters: which effect it is, how much, how sure, and what it adds to the noise of bins."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.fft import idctn
from scipy.integrate import quad
from scipy.stats import norm

from noise_model.compiled.arrays import Float64
from noise_model.effects.compression import quantisation_steps
from sim_to_real.data.blocks import block_means
from sim_to_real.variance import random_effects as of_scatter
from sim_to_real.variance.random_effects import MIN_EVIDENCE_NATS, random_effects
from tests.sim_to_real.scattered import BIN_PX, HEIGHT, WIDTH, Scattering, recorded, streak

RANDOM = {"read_noise", "fixed_pattern", "laser_speckle", "spatter"}
SOUGHT = RANDOM | {"image_compression"}
N_FRAMES = 18


def streaks(rng):
    """A streak off the stripe in each frame with the arc on."""
    drawn = np.zeros((N_FRAMES, HEIGHT, WIDTH))
    for n in range(N_FRAMES):
        if n % 6 > 1:
            place = (
                rng.uniform(30.0, WIDTH - 30.0),
                rng.uniform(125.0, HEIGHT - 30.0),
                rng.uniform(0.0, math.pi),
            )
            drawn[n] = streak(*place, 40.0, 1.8, 2000.0)
    return drawn


def made(effect):
    """A recording with one effect, and what its parameters are."""
    rng = np.random.default_rng(11)
    given = {
        "nothing": (Scattering(), {}),
        "read_noise": (Scattering(ratio=1.8), {"noise_ratio": 1.8}),
        "fixed_pattern": (Scattering(pixels=0.03), {"sigma_rel": 0.03}),
        "laser_speckle": (Scattering(contrast=0.15, grain_px=1.0), {"contrast": 0.15, "grain_px": 1.0}),
        "spatter": (Scattering(drawn=streaks(rng)), {"length_px": 40.0, "width_px": 1.8}),
    }
    scattering, values = given[effect]
    return recorded(rng, scattering, N_FRAMES), values


def test_nothing_is_found_where_nothing_is():
    (expected, fitted), _ = made("nothing")
    effects_found = random_effects(expected, fitted, ())
    assert effects_found.effects == {}
    assert set(effects_found.evidence) == set(effects_found.confidence) == set(effects_found.closed) == SOUGHT
    assert max(effects_found.confidence.values()) < 0.5
    for sigma_dn, frame in zip(effects_found.sigmas_dn, expected.observed.frames, strict=True):
        assert (sigma_dn == frame.sigma_dn).all()


@pytest.mark.slow
@pytest.mark.parametrize("effect", sorted(RANDOM))
def test_each_effect_is_found_alone_with_its_parameters(effect):
    (expected, fitted), values = made(effect)
    effects_found = random_effects(expected, fitted, ())
    assert set(effects_found.effects) == {effect}
    for name, value in values.items():
        # Read noise is known within its tolerance of 5 %.
        assert effects_found.effects[effect][name] == pytest.approx(
            value, abs=2.0 * effects_found.sigmas[effect][name]
        )
        assert effects_found.sigmas[effect][name] < 0.3 * value
    assert effects_found.confidence[effect] == pytest.approx(
        1.0 / (1.0 + math.exp(-effects_found.evidence[effect]))
    )
    assert effects_found.confidence[effect] > 1.0 / (1.0 + math.exp(-MIN_EVIDENCE_NATS))
    assert max(given for name, given in effects_found.confidence.items() if name != effect) < 0.5
    assert effects_found.closed[effect] > 0.6
    assert max(given for name, given in effects_found.closed.items() if name != effect) < 0.2


@pytest.mark.parametrize("ratio", [0.93, 1.07])
def test_read_noise_within_its_tolerance_is_no_effect_but_known(ratio):
    """A tolerance of 5 %: what is seen is surer than that."""
    effects_found = random_effects(
        *recorded(np.random.default_rng(12), Scattering(ratio=ratio), N_FRAMES), ()
    )
    assert "read_noise" not in effects_found.effects
    assert effects_found.read_ratio == pytest.approx(ratio, abs=0.01)


def test_read_noise_that_is_named_is_not_counted_twice():
    (expected, fitted), _ = made("read_noise")
    assert random_effects(expected, fitted, ()).read_ratio == 1.0


def pixels_exceed(expected, fitted):
    """By how much the mean square of pixels' residuals exceeds their stated noise, in the bins that count."""
    ratios = []
    for frame, light in zip(expected.observed.frames, fitted.lights, strict=True):
        blocks = frame.image_dn.reshape(60, 4, 80, 4).transpose(0, 2, 1, 3)[frame.keep].reshape(-1, 16)
        gain, read = light.sensor.gain_e_per_dn, light.sensor.read_noise_e
        variance = (light.arc_e + light.laser_e + read**2) / gain**2 + 1.0 / 12.0
        # Within a bin light has its own slope: neighbours along rows and columns say what is noise.
        change = blocks[:, [1, 6, 9, 14]].astype(Float64.__args__[1].__args__[0]) - blocks[:, [2, 5, 10, 13]]
        ratios.append(0.5 * np.mean(change**2, axis=1) / variance)
    return float(np.mean(np.concatenate(ratios))) - 1.0


@pytest.mark.parametrize("effect", ["read_noise", "fixed_pattern"])
def test_what_an_effect_adds_is_what_pixels_exceed(effect):
    (expected, fitted), _ = made(effect)
    assert random_effects(expected, fitted, ()).excess[effect] == pytest.approx(
        pixels_exceed(expected, fitted), rel=0.1
    )


def test_noise_of_bins_is_what_bins_scatter_by():
    (expected, fitted), _ = made("laser_speckle")
    effects_found = random_effects(expected, fitted, ())
    r = [
        ((frame.kept_dn - light.mean_dn()) / sigma_dn)[frame.in_stripe & (light.laser_e > 2000.0)]
        for frame, light, sigma_dn in zip(
            expected.observed.frames, fitted.lights, effects_found.sigmas_dn, strict=True
        )
    ]
    # The floor of half a DN that the frames' noise has beside it is small here.
    assert np.sqrt(np.mean(np.concatenate(r) ** 2)) == pytest.approx(1.0, abs=0.15)


def test_noise_that_bins_have_been_given_already_is_not_added_again():
    """As of a recording whose photon transfer has shown it."""
    (expected, fitted), _ = made("read_noise")
    observed = expected.observed
    sensor = observed.setup.sensor

    def given(frame, light):
        # Read noise of 1.8 times the stated one, in bins.
        shown_dn2 = (1.8**2 - 1.0) * (sensor.read_noise_e / sensor.gain_e_per_dn / observed.bin_px) ** 2
        shown = np.full(len(frame.sigma_dn), shown_dn2)
        return replace(frame, sigma_dn=np.sqrt(frame.sigma_dn**2 + shown), shown_dn2=shown)

    frames = tuple(given(*values) for values in zip(observed.frames, fitted.lights, strict=True))
    effects_found = random_effects(type(expected)(observed=replace(observed, frames=frames)), fitted, ())
    assert set(effects_found.effects) == {"read_noise"}
    for sigma_dn, frame in zip(effects_found.sigmas_dn, frames, strict=True):
        assert np.median(sigma_dn / frame.sigma_dn) == pytest.approx(1.0, abs=0.01)


def test_of_a_read_noise_that_is_stated_in_part_the_whole_is_found():
    (expected, fitted), _ = made("read_noise")
    setup = expected.observed.setup
    known = replace(setup.sensor, read_noise_e=1.5 * setup.sensor.read_noise_e)
    stated = replace(expected.observed, setup=replace(setup, effects={"read_noise": {"noise_ratio": 1.5}}))
    really_there = [replace(light, sensor=known) for light in fitted.lights]
    effects_found = random_effects(type(expected)(observed=stated), type(fitted)(lights=really_there), ())
    assert effects_found.effects["read_noise"]["noise_ratio"] == pytest.approx(1.8, abs=0.05)


@pytest.mark.slow
def test_bins_that_a_streak_reaches_do_not_count():
    (expected, fitted), _ = made("spatter")
    effects_found = random_effects(expected, fitted, ())
    hit = [np.isinf(sigma_dn).any() for sigma_dn in effects_found.sigmas_dn]
    assert hit == [n % 6 > 1 for n in range(N_FRAMES)]


def test_an_effect_out_of_the_catalogue_is_not_looked_for():
    (expected, fitted), _ = made("fixed_pattern")
    effects_found = random_effects(expected, fitted, ("fixed_pattern",))
    assert effects_found.effects == {}
    assert set(effects_found.confidence) == SOUGHT - {"fixed_pattern"}


def test_what_the_setup_states_is_noise_and_no_gap():
    (expected, fitted), _ = made("fixed_pattern")
    effects = {"fixed_pattern": {"sigma_rel": 0.03}}
    stated = replace(expected.observed, setup=replace(expected.observed.setup, effects=effects))
    effects_found = random_effects(type(expected)(observed=stated), fitted, ())
    assert effects_found.effects == {}
    assert all(
        (s > f.sigma_dn).any()
        for s, f in zip(effects_found.sigmas_dn[2:], stated.frames[2:], strict=True)
        if f.condition.arc_level
    )


def test_effects_of_sources_that_are_hardly_on_are_not_looked_for():
    (expected, fitted), _ = made("nothing")
    dark = [0, 6, 12]
    few = replace(
        expected.observed,
        frames=tuple(replace(expected.observed.frames[n], position=k) for k, n in enumerate(dark)),
    )
    fit = type(fitted)(lights=tuple(fitted.lights[n] for n in dark))
    assert set(random_effects(type(expected)(observed=few), fit, ()).confidence) == {
        "read_noise",
        "image_compression",
    }


@pytest.mark.slow
@pytest.mark.parametrize("quality", [12, 35])
def test_the_lines_that_compression_leaves_are_no_streaks(quality):
    """The frames went through OpenCV's JPEG, whose blocks have lines of their own."""
    expected, fitted = recorded(np.random.default_rng(5), Scattering(), N_FRAMES)
    frames = []
    for frame in expected.observed.frames:
        codes = cv2.imencode(".jpg", frame.image_dn, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        image_dn = cv2.imdecode(codes, cv2.IMREAD_UNCHANGED)
        binned_dn = block_means(image_dn, BIN_PX).astype(np.float32)
        frames.append(replace(frame, image_dn=image_dn, binned_dn=binned_dn))
    expected.observed = replace(expected.observed, frames=tuple(frames))
    assert set(random_effects(expected, fitted, ()).effects) == {"image_compression"}


@pytest.mark.parametrize("bin_px", [1, 2, 3, 4, 8])
def test_what_rounding_leaves_in_bins_is_that_of_each_wave(bin_px):
    """Every wave of a block off by an even draw of its step."""
    rng, quality = np.random.default_rng(3), 40.0
    off = quantisation_steps(quality) * rng.uniform(-0.5, 0.5, (90, 90, 8, 8))
    image = idctn(off, axes=(2, 3), norm="ortho").swapaxes(1, 2).reshape(720, 720)
    assert of_scatter.coded_dn2(quality, bin_px) == pytest.approx(
        np.var(block_means(image, bin_px)), rel=0.05
    )


@pytest.mark.parametrize(("size", "error", "prior"), [(0.2, 0.06, 1.0), (0.0, 0.05, 1.0), (-0.1, 0.05, 0.5)])
def test_the_evidence_is_the_ratio_of_two_integrals(size, error, prior):
    with_it, _ = quad(
        lambda x: norm.pdf(size, x, error) * 2.0 * norm.pdf(x, 0.0, prior), 0.0, 6.0, points=[max(size, 0.0)]
    )
    expected = math.log(with_it / norm.pdf(size, 0.0, error))
    assert of_scatter.evidence_over_zero(size, error, prior) == pytest.approx(expected, rel=1e-6)
