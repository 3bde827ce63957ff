"""Spatter's parameters, and the evidence for it."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import expon, gamma, poisson

from sim_to_real.variance import spatter as of_spatter
from sim_to_real.variance.spatter import spatter
from tests.sim_to_real.scattered import HEIGHT, NO_MORE, SENSOR, WIDTH, Scattering, light_e, recorded, streak

N_FRAMES, LENGTH_PX, WIDTH_PX, PEAK_E = 24, 40.0, 1.8, 3000.0


def drawn(rng, rate, peak_e=PEAK_E):
    """Streaks of the catalogue's kind in the frames with the arc on, and their peaks."""
    images, peaks = np.zeros((N_FRAMES, HEIGHT, WIDTH)), []
    for n, image in enumerate(images):
        for _ in range(rng.poisson(rate) if light_e(n)[0].any() else 0):
            place = rng.uniform(0.0, WIDTH), rng.uniform(0.0, HEIGHT), rng.uniform(0.0, math.pi)
            peaks.append(rng.exponential(peak_e))
            image += streak(*place, LENGTH_PX, WIDTH_PX, peaks[-1])
    return images, peaks


def found_of(images=None, seed=7):
    expected, fitted = recorded(
        np.random.default_rng(seed), Scattering(drawn=images), N_FRAMES, with_stripe=False
    )
    return spatter(expected.observed, fitted.lights, NO_MORE)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "rate", "peak_e"), [(1, 1.0, PEAK_E), (2, 2.5, PEAK_E), (3, 1.5, 18_000.0)])
def test_parameters_of_drawn_streaks_come_back(seed, rate, peak_e):
    """Of peaks of 18 000 e- on average every other saturates."""
    images, peaks = drawn(np.random.default_rng(seed), rate, peak_e)
    result = found_of(images)
    n_lit = sum(light_e(n)[0].any() for n in range(N_FRAMES))
    assert result.evidence > 5.0
    # Those in the image's middle alone are drawn: of those at its rim a part is seen.
    assert result.values["rate_per_frame"] == pytest.approx(len(peaks) / n_lit, rel=0.25)
    assert result.values["peak_e"] == pytest.approx(np.mean(peaks), abs=2.5 * result.sigmas["peak_e"])
    assert result.values["length_px"] == pytest.approx(LENGTH_PX, abs=1.5)
    assert result.values["width_px"] == pytest.approx(WIDTH_PX, abs=0.2)


@pytest.mark.slow
def test_few_sigmas_of_many_recordings_lie_far_off():
    """The stated sigmas are those of the estimates: their squares over truth are about one on average."""
    off = []
    for seed in range(4):
        result = found_of(drawn(np.random.default_rng(100 + seed), 2.0)[0], seed)
        off.append(
            [
                (result.values[name] - true) / result.sigmas[name]
                for name, true in (("rate_per_frame", 2.0), ("peak_e", PEAK_E), ("length_px", LENGTH_PX))
            ]
        )
    assert (np.sqrt(np.mean(np.square(off), axis=0)) < 2.0).all()
    assert (np.abs(np.mean(off, axis=0)) < 1.5).all()


def test_the_evidence_is_that_of_two_distributions_of_rates():
    """Integrated over the rates: exponential ones of spatter, Gamma-distributed ones of other lines."""
    n, n_lit, n_others, n_frames = 7, 9, 2, 13
    mean = of_spatter.PARAMETERS["rate_per_frame"].prior_sigma
    of_spatter_rate, _ = quad(lambda r: poisson.pmf(n, n_lit * r) * expon.pdf(r, scale=mean), 0.0, 50.0)
    of_others = gamma(0.5 + n_others, scale=1.0 / (of_spatter.CLUTTER_FRAMES + n_frames))
    of_clutter, _ = quad(lambda r: poisson.pmf(n, n_lit * r) * of_others.pdf(r), 0.0, 5.0)
    evidence = of_spatter.streak_evidence(n, n_lit, n_others, n_frames)
    assert evidence == pytest.approx(math.log(of_spatter_rate / of_clutter), rel=1e-5)


@pytest.mark.slow
def test_lines_where_no_spatter_can_be_speak_against_it():
    rng = np.random.default_rng(3)
    places = rng.uniform((30.0, 40.0, 0.0), (130.0, HEIGHT - 40.0, math.pi), (N_FRAMES, 3))
    lit, unlit = (np.zeros((N_FRAMES, HEIGHT, WIDTH)) for _ in range(2))
    for n, (u, v, angle) in enumerate(places):
        item, other = (streak(place, v, angle, LENGTH_PX, WIDTH_PX, 1000.0) for place in (u, u + 150.0))
        if light_e(n)[0].any():
            lit[n] = item
        else:
            unlit[n] = item + other
    alone = found_of(lit).evidence
    assert alone > 10.0
    assert found_of(lit + unlit).evidence < 0.3 * alone


def test_without_streaks_there_is_no_spatter():
    result = found_of()
    assert result.evidence < -2.0
    assert result.values == {}
    assert result.excess == 0.0
    assert not np.any(result.hit)


@pytest.mark.slow
def test_streaks_add_what_their_pixels_exceed_their_noise():
    images, _ = drawn(np.random.default_rng(4), 1.0)
    light = np.array([light_e(n)[0] for n in range(N_FRAMES)])
    variance = light + SENSOR.read_noise_e**2 + SENSOR.gain_e_per_dn**2 / 12.0
    seen = np.minimum(images, SENSOR.full_well_e - light)
    # Pixels in the noise and streaks that are hardly seen are left out.
    assert found_of(images).excess == pytest.approx(np.mean(seen**2 / variance), rel=0.25)
