"""Evidence for a joint: how often a plain plate shows as much, and what real joints show."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import PX_MM, Profile, fit_joint, groove, lap, measure, spoil
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import Joint
from tracker.joint.evidence import (
    MIN_EVIDENCE_NATS,
    PLATE_STEPS,
    RUN_PRIOR,
    fit_plate,
    gap_evidence_nats,
    loss,
    pair_correlation,
    places_of,
    runs_of,
    section_evidence_nats,
)
from tracker.joint.wander import MIN_CORRELATION, Wander, innovations, points_as_one, wander_of

LINE = ((-100.0, 0.0, 0.0), (100.0, 0.0, 0.0))
CAMERA_MM, LASER_MM = np.array([60.0, 0.0, 130.0]), np.array([0.0, 0.0, 140.0])
JOINTS = {
    "v_groove": Joint("v_groove", {"included_angle_deg": 60.0, "depth_mm": 4.0, "root_gap_mm": 1.0}, LINE),
    "lap": Joint("lap", {"thickness_mm": 2.0}, LINE),
    "half_v": Joint("half_v", {"bevel_angle_deg": 45.0, "depth_mm": 4.0, "root_gap_mm": 1.0}, LINE),
    "fillet": Joint("fillet", {"included_angle_deg": 90.0}, LINE),
}
REACH_MM = 5.5
PLATE = np.array([(-60.0, 0.0), (60.0, 0.0)])
seeds = st.integers(0, 2**32 - 1)


def scattered(rng: np.random.Generator, grain: float, bow_mm: float = 0.0) -> Profile:
    """A plate whose centres are off by 0.2 px, each by itself or alike within a grain."""
    exact = measure(PLATE, (0.0, 0.0), rng, noise=False)
    n = len(exact.y_mm)
    reach = np.arange(-20.0, 21.0)
    kernel = np.exp(-0.5 * (reach / max(grain, 1e-3)) ** 2)
    kernel /= np.linalg.norm(kernel)
    error = 0.2 * np.convolve(rng.normal(size=n + 40), kernel, "valid")
    z = exact.z_mm + PX_MM[1] * error + bow_mm * (exact.y_mm / 18.0) ** 2
    sigma = np.full(n, 0.2)
    return replace(exact, z_mm=z, sigma_px=sigma, beside_px=sigma * float(kernel.sum()), reach_mm=REACH_MM)


@pytest.mark.slow
@pytest.mark.parametrize("bow_mm", [0.0, 0.5])
@pytest.mark.parametrize("grain", [0.0, 2.0])
@pytest.mark.parametrize("name", JOINTS)
def test_a_plate_shows_so_much_by_chance_no_more_often_than_is_said(
    name: str, grain: float, bow_mm: float
) -> None:
    """Evidence beyond x has the probability exp(-x) at most, of white noise and of neighbours off alike."""
    rng, shown, n = np.random.default_rng(3), [], 300
    for _ in range(n):
        found = fit_joint(scattered(rng, grain, bow_mm), JOINTS[name], CAMERA_MM, LASER_MM)
        shown.append(-math.inf if found is None else found.evidence_nats)
    shares = [float(np.mean(np.array(shown) > x)) for x in (1.0, 2.0, MIN_EVIDENCE_NATS)]
    print(f"{name}, grain {grain}, bow {bow_mm}: most {max(shown):.1f} nats, beyond 1, 2, 6.9: {shares}")
    for x, share in zip((1.0, 2.0), shares, strict=False):
        said = math.exp(-x)
        assert share <= said + 3.0 * math.sqrt(said * (1.0 - said) / n)
    # One of a thousand is allowed: of these, two at most.
    assert shares[-1] * n <= 2.0


@pytest.mark.parametrize("sigma_px", [0.05, 0.5])
@pytest.mark.parametrize("name", ["v_groove", "lap"])
def test_a_joint_is_told_from_a_plate(name: str, sigma_px: float) -> None:
    corners = groove((30.0, 30.0), (4.0, 4.0), 1.0) if name == "v_groove" else lap(2.0)
    rng, least = np.random.default_rng(4), math.inf
    for _ in range(20):
        profile = replace(measure(corners, (0.4, -0.2), rng, sigma_px=sigma_px), reach_mm=REACH_MM)
        found = fit_joint(profile, JOINTS[name], CAMERA_MM, LASER_MM)
        assert found is not None
        least = min(least, found.evidence_nats)
    print(f"{name}, {sigma_px} px: {least:.0f} nats at least")
    assert least > 4.0 * MIN_EVIDENCE_NATS


@settings(deadline=None, max_examples=15)
@given(seeds, st.floats(0.5, 0.95), st.floats(0.3, 3.0))
def test_what_is_new_in_residuals_is_white(seed: int, left: float, wander: float) -> None:
    """A third of the lines is lost. Noise and wander have no neighbours once they are foreseen."""
    rng, n = np.random.default_rng(seed), 6000
    waves = lfilter([math.sqrt(wander * (1.0 - left * left))], [1.0, -left], rng.standard_normal(n))
    off = waves + rng.standard_normal(n)
    seen = wander_of(off, np.ones(n))
    assert seen.own + seen.wander == pytest.approx(1.0 + wander, rel=0.25)
    scan = np.flatnonzero(np.arange(n) % 3 > 0).astype(float)
    new = innovations(off[scan.astype(int)], scan, np.ones(len(scan)), Wander(1.0, wander, left))
    assert new.std() == pytest.approx(1.0, abs=0.05)
    assert abs(new[1:] @ new[:-1]) / (new @ new) < 0.05


@settings(deadline=None, max_examples=15)
@given(seeds, st.floats(0.1, 0.95), st.floats(0.1, 5.0))
def test_innovations_have_the_likelihood_of_the_whole_covariance(
    seed: int, left: float, wander: float
) -> None:
    """The mean of two lines has the mean of their rows and columns."""
    rng, n = np.random.default_rng(seed), 40
    n_lines = rng.choice([1.0, 2.0], n)
    first = np.cumsum(rng.integers(2, 5, n)).astype(float)
    last, scan = first + n_lines - 1.0, first + 0.5 * (n_lines - 1.0)
    off = 2.0 * rng.standard_normal(n)
    covariance = np.diag(0.7 / n_lines)
    for one in (first, last):
        for other in (first, last):
            covariance += 0.25 * wander * left ** np.abs(one[:, None] - other)
    new = innovations(off, scan, n_lines, Wander(0.7, wander, left))
    assert new @ new == pytest.approx(off @ np.linalg.solve(covariance, off), rel=1e-9)


@settings(deadline=None, max_examples=15)
@given(seeds, st.floats(0.5, 0.95), st.floats(0.3, 3.0))
def test_means_of_two_lines_tell_what_the_lines_do(seed: int, left: float, wander: float) -> None:
    rng, n = np.random.default_rng(seed), 20000
    waves = lfilter([math.sqrt(wander * (1.0 - left * left))], [1.0, -left], rng.standard_normal(n))
    off = waves + rng.standard_normal(n)
    means = off.reshape(-1, 2).mean(axis=1)
    alone, paired = wander_of(off, np.ones(n)), wander_of(means, np.full(n // 2, 2.0))
    assert paired.correlation == pytest.approx(alone.correlation, abs=0.2)
    assert paired.own + paired.wander == pytest.approx(alone.own + alone.wander, rel=0.2)
    new = innovations(means, np.arange(n // 2) * 2.0 + 0.5, np.full(n // 2, 2.0), paired)
    assert new.std() == pytest.approx(1.0, abs=0.1)
    assert abs(new[1:] @ new[:-1]) / (new @ new) < 0.15


@settings(deadline=None, max_examples=20)
@given(st.floats(0.0, 12.0), st.floats(0.0, 0.6))
def test_a_mean_of_two_lines_loses_what_both_would(off: float, correlation: float) -> None:
    """Two lines lie about their mean with a variance of (1 - alike) / 2."""
    apart = np.random.default_rng(21).standard_normal(40000) * math.sqrt(0.5 * (1.0 - correlation))
    middle = off * math.sqrt(0.5 * (1.0 + correlation))
    both = loss(middle + np.concatenate([apart, -apart]), np.ones(80000), 0.0) / 40000
    assert loss(np.array([off]), np.array([2.0]), correlation) == pytest.approx(both, rel=0.05, abs=0.01)


@pytest.mark.parametrize("correlation", [0.0, 0.4])
def test_lines_read_as_one_are_as_correlated_as_their_sigmas_say(correlation: float) -> None:
    n_lines = np.where(np.arange(90) < 60, 2.0, 1.0)
    sigma = 0.3 * np.where(n_lines > 1.0, math.sqrt(0.5 * (1.0 + correlation)), 1.0)
    found = pair_correlation(sigma, n_lines)
    assert found.correlation == pytest.approx(max(correlation - MIN_CORRELATION, 0.0))
    assert found.share == pytest.approx(0.8)
    assert pair_correlation(sigma[60:], n_lines[60:]) == (0.0, 0.0)


def test_a_groove_in_coarse_texture_is_told_from_a_plate() -> None:
    """Centres wander by a sigma and a half over tens of lines; a groove's corners are sharper than that."""
    rng = np.random.default_rng(6)
    profile = measure(groove((30.0, 30.0), (4.0, 4.0), 1.0), (0.0, 0.0), rng, sigma_px=0.3)
    wander = gaussian_filter1d(rng.standard_normal(len(profile.y_mm)), 12.0)
    bent = profile.z_mm + 1.5 * profile.dz_mm * profile.sigma_px * wander / wander.std()
    found = fit_joint(replace(profile, z_mm=bent, reach_mm=REACH_MM), JOINTS["v_groove"], CAMERA_MM, LASER_MM)
    assert found is not None
    assert found.evidence_nats > 2.0 * MIN_EVIDENCE_NATS


def test_residuals_that_wander_count_as_few() -> None:
    """Of an AR(1) with coefficient r the mean counts (1 + r) / (1 - r) neighbours as one."""
    rng, r, n = np.random.default_rng(12), 0.8, 4000
    white = rng.standard_normal(n)
    wandering = lfilter([math.sqrt(1.0 - r * r)], [1.0, -r], white)
    assert points_as_one(white) == pytest.approx(1.0, abs=0.3)
    assert points_as_one(wandering) == pytest.approx((1.0 + r) / (1.0 - r), rel=0.25)
    # Spatter between is no neighbour of anything.
    spattered = np.where(rng.random(n) < 0.05, 50.0, wandering)
    assert points_as_one(spattered) == pytest.approx((1.0 + r) / (1.0 - r), rel=0.3)
    assert points_as_one(np.zeros(8)) == 1.0


def test_a_plate_that_coarse_texture_bends_is_no_joint() -> None:
    """Its stripe wanders by two sigmas over 40 lines: a lap's step is soon found in that."""
    rng, n_told, n = np.random.default_rng(13), 0, 20
    for _ in range(n):
        profile = measure(PLATE, (0.0, 0.0), rng, sigma_px=3.0)
        wander = gaussian_filter1d(rng.standard_normal(len(profile.y_mm)), 15.0)
        bent = profile.z_mm + 2.0 * profile.dz_mm * profile.sigma_px * wander / wander.std()
        found = fit_joint(replace(profile, z_mm=bent, reach_mm=REACH_MM), JOINTS["lap"], CAMERA_MM, LASER_MM)
        n_told += found is not None and found.evidence_nats > MIN_EVIDENCE_NATS
    assert n_told == 0


def test_points_off_a_section_are_worse_witnesses_of_it() -> None:
    """Sigmas that are half of what points scatter by gain the section no more than true ones do."""
    rng = np.random.default_rng(11)
    profile = measure(groove((30.0, 30.0), (4.0, 4.0), 1.0), (0.0, 0.0), rng, sigma_px=1.0)
    stated = replace(profile, sigma_px=0.5 * profile.sigma_px, beside_px=0.5 * profile.beside_px)
    told = [fit_joint(p, JOINTS["v_groove"], CAMERA_MM, LASER_MM) for p in (profile, stated)]
    assert told[0] is not None
    assert told[1] is not None
    assert told[1].chi2 > 2.5
    assert told[1].evidence_nats < 1.2 * told[0].evidence_nats


def loss_of(profile: Profile) -> float:
    """Tukey's loss of the plate that fits a profile best: 4.685^2 / 6 (1 - (1 - (r / 4.685)^2)^3) a point."""
    off = np.empty(len(profile.y_mm))
    fit_plate(
        profile.y_mm, profile.z_mm, profile.dy_mm, profile.dz_mm, profile.sigma_px, profile.lines_each, off
    )
    inside = np.minimum((off / 4.685) ** 2, 1.0)
    return float(np.sum(4.685**2 / 6.0 * (1.0 - (1.0 - inside) ** 3)))


def test_what_lies_on_a_section_as_on_a_plate_speaks_for_none() -> None:
    profile = measure(PLATE, (0.0, 0.0), np.random.default_rng(6))
    assert section_evidence_nats(profile.points, PLATE, profile.reach_mm) < 0.0
    assert loss_of(profile) < 0.7 * len(profile.y_mm)


def test_a_plates_cubic_and_some_spatter_are_no_loss() -> None:
    rng = np.random.default_rng(7)
    plain = measure(PLATE, (0.0, 0.0), rng)
    bowed = replace(plain, z_mm=plain.z_mm + 1e-2 * plain.y_mm**2 - 1e-4 * plain.y_mm**3)
    assert loss_of(bowed) == pytest.approx(loss_of(plain), rel=0.02)
    spatter = plain.z_mm.copy()
    spatter[::25] += 2.0
    loss = loss_of(replace(plain, z_mm=spatter)) - loss_of(plain)
    # Tukey's loss of a point that is far off: his width's square over 6, less what it would have had.
    assert loss == pytest.approx(len(spatter[::25]) * (4.685**2 / 6.0 - 0.5), rel=0.15)


def plate_twin(profile: Profile) -> Float64:
    """How far points lie off the cubic that fits them best, in their sigmas, by NumPy's least squares."""
    middle, half = profile.y_mm.mean(), np.ptp(profile.y_mm) / 2.0
    basis = np.vander((profile.y_mm - middle) / half, 4)
    steepness = basis[:, 1:] * [3.0, 2.0, 1.0] / half
    slope, weights, off = np.zeros(len(basis)), np.ones(len(basis)), np.empty(len(basis))
    for _ in range(PLATE_STEPS):
        unit = np.abs(profile.dz_mm - slope * profile.dy_mm) * profile.sigma_px
        root = np.sqrt(weights)[:, np.newaxis] / unit[:, np.newaxis]
        p = np.linalg.lstsq(root * basis, root[:, 0] * profile.z_mm, rcond=None)[0]
        off = (profile.z_mm - basis @ p) / unit
        scale = 4.685 * max(1.0, 1.4826 * np.median(np.abs(off)))
        weights, slope = np.maximum(1.0 - (off / scale) ** 2, 0.0) ** 2, steepness @ p[:-1]
    return np.asarray(off)


@settings(deadline=None, max_examples=30)
@given(seeds, st.floats(0.0, 0.3), st.sampled_from([PLATE, groove((30.0, 30.0), (4.0, 4.0), 1.0), lap(2.0)]))
def test_a_plates_fit_is_its_twin(seed: int, spoiled: float, corners: Float64) -> None:
    rng = np.random.default_rng(seed)
    profile = spoil(measure(corners, (1.0, 0.5), rng), spoiled, rng)
    off = np.empty(len(profile.y_mm))
    fit_plate(
        profile.y_mm, profile.z_mm, profile.dy_mm, profile.dz_mm, profile.sigma_px, profile.lines_each, off
    )
    # Its weights' scale is the median of float32.
    np.testing.assert_allclose(off, plate_twin(profile), rtol=1e-5, atol=1e-5)


def test_points_at_a_single_place_have_a_plate_too() -> None:
    place, off = np.full(30, 2.0), np.empty(30)
    fit_plate(place, place, np.zeros(30), np.ones(30), np.ones(30), np.ones(30), off)
    assert np.isfinite(off).all()


@given(seeds, st.integers(1, 60), st.floats(0.0, 1.0))
def test_runs_are_their_twin(seed: int, n: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    is_lost = rng.random(n) < share
    first = int(rng.integers(0, n))
    last = int(rng.integers(first, n))
    parts = is_lost[:first], is_lost[last + 1 :]
    begun = sum(int((part & ~np.append(False, part[:-1])).sum()) for part in parts if len(part))
    gone_on = sum(int((part[1:] & part[:-1]).sum()) for part in parts)
    assert runs_of(is_lost, first, last) == (n - (last - first + 1), begun, gone_on)


@settings(deadline=None, max_examples=50)
@given(seeds, st.floats(0.0, 0.4), st.integers(1, 6))
def test_a_longer_gap_says_more(seed: int, share: float, width: int) -> None:
    rng = np.random.default_rng(seed)
    is_lost = rng.random(200) < share
    is_lost[90:110] = False

    def told(lost: np.ndarray, lines: int) -> float:
        gap = lost.copy()
        gap[100 : 100 + lines] = True
        return gap_evidence_nats(gap, 100, 99 + lines, 80.0)

    assert told(is_lost, width + 1) > told(is_lost, width)
    assert gap_evidence_nats(np.zeros(200, bool), 100, 104, 80.0) == -math.inf


def test_a_gap_among_lines_of_which_none_is_lost_is_as_rare_as_the_prior_says() -> None:
    is_lost = np.zeros(200, bool)
    is_lost[100:104] = True
    a, b = RUN_PRIOR
    # The moment of a beta distribution: q^3 on average.
    cube = math.gamma(a + 3.0) * math.gamma(a + b) / math.gamma(a) / math.gamma(a + b + 3.0)
    rare = -math.log(0.5 / 197.0 * 80.0) - math.log(cube)
    assert gap_evidence_nats(is_lost, 100, 103, 80.0) == pytest.approx(rare)


@pytest.mark.parametrize(
    ("rate", "goes_on", "most"), [(0.02, 0.1, 0.001), (0.02, 0.5, 0.04), (0.05, 0.5, 0.015)]
)
def test_chance_seldom_gives_a_gap(rate: float, goes_on: float, most: float) -> None:
    """Lines are lost in runs; the longest of them anywhere is taken for the gap, as a search would.

    What it leaves beside itself are shorter runs: where most go on they tell too little of that, and chance
    gives a gap oftener than said, if still seldom.
    """
    rng, n, shown = np.random.default_rng(8), 320, []
    for _ in range(2000):
        is_lost = np.zeros(n, bool)
        for i in range(n):
            is_lost[i] = rng.random() < (goes_on if i and is_lost[i - 1] else rate)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], is_lost, [False]]).astype(int)))
        if not len(edges):
            continue
        first, end = edges.reshape(-1, 2)[np.argmax(np.diff(edges.reshape(-1, 2))[:, 0])]
        shown.append(gap_evidence_nats(is_lost, int(first), int(end) - 1, float(n)))
    share = float(np.sum(np.array(shown) > MIN_EVIDENCE_NATS)) / 2000.0
    print(f"rate {rate}, goes on {goes_on}: a gap in {share:.4f}")
    assert share <= most


def test_a_profile_is_searched_at_one_place_at_least() -> None:
    profile = measure(PLATE, (0.0, 0.0), np.random.default_rng(9))
    span_mm = float(np.ptp(profile.y_mm))
    assert places_of(profile.y_mm, profile.reach_mm, 0.5) == pytest.approx(span_mm / 0.5)
    assert places_of(profile.y_mm, 2.0, 0.5) == pytest.approx(8.0)
    assert places_of(profile.y_mm, 0.1, 0.5) == 1.0
