"""The ends of stripes within a scan line, on bands drawn from closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import Profile
from scipy.special import ndtr
from stripe_ends import (
    DARK_E2,
    DEPTH,
    EDGE,
    N_SCAN,
    PSF_PX,
    WIDTH_PX,
    light_of,
    profile_of,
)

from tracker.joint.measured import OnFace, meet_face
from tracker.joint.plate_lines import UNREAD, OnPlates, plate_lines
from tracker.joint.upright_edge import Edge, EdgeScatter, HiddenStrip, edge_covariance, upright_edge
from tracker.stripe.edge import (
    MIN_SIGMA,
    MIN_STRIPE_SHARE,
    SEEN_SIDE_SHARE,
    SIDE_CORRELATION,
    SIDE_SHARE,
    SPREAD,
    STEP,
    LineShares,
    end_misfit,
    fit_end,
    stripe_end,
    stripe_ends,
)
from tracker.stripe.light import BEYOND, NO_LIGHT, EdgeLines, StripeLight, line_room, line_shares


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("apart_px", [6.0, -15.0])
@pytest.mark.parametrize("hidden", [0.0, 1.3])
@pytest.mark.parametrize("off", [-0.5, -0.2, 0.0, 0.37])
def test_ends_without_noise_are_found_exactly(
    off: float, hidden: float, apart_px: float, flipped: bool
) -> None:
    true = (EDGE + off, EDGE + off + hidden)
    light = light_of(np.random.default_rng(0), *true, apart_px=apart_px, noise=False, flipped=flipped)
    last, first = math.floor(true[0]), math.ceil(true[1])
    if flipped:
        last, first = N_SCAN - 1 - last, N_SCAN - 1 - first
    ends = stripe_ends(light, last, first, 0.0)
    for found, line in zip(ends, true, strict=True):
        assert (N_SCAN - 1 - found.line if flipped else found.line) == pytest.approx(line, abs=0.01)
        assert MIN_SIGMA <= found.sigma < 0.15


@pytest.mark.parametrize(("contrast", "correlation"), [(0.1, 0.0), (0.2, 0.0), (0.2, 0.8)])
def test_their_sigma_is_honest(contrast: float, correlation: float) -> None:
    rng, off, stated = np.random.default_rng(4), [], []
    for _ in range(200):
        true = EDGE + rng.uniform(-0.5, 0.5)
        side = rng.normal(0.0, SIDE_SHARE)
        ends = true, true + 4.0
        light = light_of(
            rng, *ends, peak_e=600.0, contrast=contrast, correlation=correlation, side_share=side
        )
        for found, line in zip(stripe_ends(light, EDGE - 1, EDGE + 5, 0.0), ends, strict=True):
            off.append(found.line - line)
            # The floor is for real edges.
            stated.append(math.sqrt(found.sigma**2 - MIN_SIGMA**2))
    chi2 = np.mean(np.square(np.array(off) / stated))
    print(f"contrast {contrast}: rms {np.std(off):.3f} lines, mean {np.mean(off):.4f}, chi2 {chi2:.2f}")
    assert abs(np.mean(off)) < 4.0 * np.std(off) / math.sqrt(len(off))
    assert np.std(off) < 0.2
    # Light of the upright side is allowed for beyond it, too: where the other stripe is, there is none.
    assert 0.5 < chi2 < 1.3


@pytest.mark.parametrize("skew", [-0.45, 0.3])
@pytest.mark.parametrize("side_share", [0.0, 0.2])
def test_ends_of_an_edge_that_crosses_the_stripe_skewed_are_found(skew: float, side_share: float) -> None:
    """Seen from beside and over a ridge, and with light on the upright side between."""
    edge, rng, off, sigma = (
        EdgeLines(skew, 0.004, abs(skew) * WIDTH_PX, 0.0),
        np.random.default_rng(3),
        [],
        [],
    )
    for _ in range(40):
        true = EDGE + rng.uniform(-3.0, -2.0), EDGE + rng.uniform(3.0, 4.0)
        light = light_of(rng, *true, edge=edge, side_share=side_share, contrast=0.02)
        # No centre is told in lines that the edge cuts.
        last, first = EDGE - 12, EDGE + 13
        light.position_px[last + 1 : first] = np.nan
        for found, line in zip(stripe_ends(light, last, first, 0.0), true, strict=True):
            off.append(found.line - line)
            sigma.append(found.sigma)
    print(f"rms {np.std(off):.3f} lines, mean {np.mean(off):.3f}, stated {np.median(sigma):.3f}")
    assert np.sqrt(np.mean(np.square(off))) < 0.15
    assert np.mean(np.square(np.array(off) / sigma)) < 1.3
    assert max(sigma) < 0.6


def test_stripes_that_lie_near_each_other_and_scatter_tell_little() -> None:
    """What moves by a tenth of their distance looks as if a tenth of it were the other's."""
    rng, off, stated = np.random.default_rng(8), [], []
    for _ in range(100):
        true = EDGE + rng.uniform(-0.5, 0.5)
        light = light_of(rng, true, true, apart_px=1.5, peak_e=30000.0, scatter_px=0.2)
        for found in stripe_ends(light, EDGE, EDGE + 1, 0.0):
            if found.sigma < 1.0:
                off.append(found.line - true)
                stated.append(found.sigma)
    assert len(off) > 50
    assert np.mean(np.square(np.array(off) / stated)) < 1.4


def test_a_stripe_that_is_not_seen_beyond_has_no_end() -> None:
    light = light_of(np.random.default_rng(1), EDGE, EDGE)
    light.position_px[EDGE + 1 :] = np.nan
    assert np.isnan(stripe_ends(light, EDGE, EDGE + 1, 0.0)).all()
    assert np.isnan(stripe_ends(light, 1, N_SCAN - 2, 0.0)).all()


def test_saturated_pixels_do_not_count() -> None:
    rng = np.random.default_rng(2)
    light = light_of(rng, EDGE + 0.2, EDGE + 0.2, noise=False)
    light.censored[:] = light.charge_e > 0.8 * light.charge_e.max()
    light.charge_e[light.censored] = 0.8 * light.charge_e.max()
    for found in stripe_ends(light, EDGE, EDGE + 1, 0.0):
        assert found.line == pytest.approx(EDGE + 0.2, abs=0.02)
    light.censored[EDGE] = True
    for found in stripe_ends(light, EDGE, EDGE + 1, 0.0):
        assert found.line == pytest.approx(EDGE + 0.2, abs=0.1)


@pytest.mark.parametrize("off_px", [12.0, 14.0])
@pytest.mark.parametrize("width_px", [1.5, 2.5])
def test_lines_that_glints_outshine_tell_no_end(off_px: float, width_px: float) -> None:
    light = light_of(np.random.default_rng(2), EDGE + 0.2, EDGE + 14.0)
    s, px = np.indices(light.charge_e.shape)
    for side_px in (-off_px, off_px):
        r_2 = (s - EDGE + 3.0) ** 2 + (px - 40.0 - side_px) ** 2
        light.charge_e[:] += 36000.0 * np.exp(-0.5 * r_2 / width_px**2)
    np.minimum(light.charge_e, 6000.0, out=light.charge_e)
    light.censored[:] = light.charge_e == 6000.0
    light.position_px[EDGE - 7 : EDGE + 14] = np.nan
    assert np.isnan(stripe_end(light, EDGE - 8, 1, 21)).all()


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.booleans())
def test_shares_are_their_twin(seed: int, n: int, back: bool) -> None:
    rng = np.random.default_rng(seed)
    light = light_of(rng, EDGE + rng.uniform(-1.0, 1.0), EDGE + rng.uniform(0.0, 2.0))
    light.censored[rng.uniform(size=light.censored.shape) < 0.01] = True
    # The stripe's own: another light's would hide its line.
    light.charge_e[light.censored] = 0.0
    light.background_e[:] += rng.normal(0.0, rng.choice([0.0, 300.0]), light.background_e.shape)
    away = -1 if back else 1
    last = EDGE - away * 4
    first = last + away * (n + 1)
    shares, variances = np.empty((2, 2, n))
    assert line_shares(light, last, first, away, BEYOND, 4, shares, variances, line_room(DEPTH))

    residual = light.charge_e.astype(np.float64) - light.background_e
    residual[light.censored] = np.nan
    r = np.arange(DEPTH, dtype=float)
    columns = []
    lines = last + away * np.arange(1, n + 1)
    for begins, step in ((last, -away), (first, away)):
        beyond = begins + step * np.arange(BEYOND)
        run = np.polynomial.Polynomial.fit(beyond, light.position_px[beyond], 1)
        seen = np.empty((n, BEYOND, DEPTH))
        for i, s in enumerate(lines):
            for k, b in enumerate(beyond):
                at = r - run(s) + light.position_px[b]
                inside = (at >= 0.0) & (at < DEPTH - 1)
                seen[i, k] = np.where(inside, np.interp(at, r, residual[b]), np.nan)
        counts = np.isfinite(seen).sum(axis=1)
        columns.append(
            (run(lines), np.where(counts >= 3, np.nansum(seen, axis=1) / np.maximum(counts, 1), np.nan))
        )
    for i, s in enumerate(lines):
        (upper, u), (lower, v) = ((run[i], seen[i]) for run, seen in columns)
        near = (r >= math.floor(min(upper, lower) - 3.0 * WIDTH_PX)) & (
            r <= math.ceil(max(upper, lower) + 3.0 * WIDTH_PX)
        )
        used = near & np.isfinite(u + v + residual[s])
        weight = (
            1.0
            / np.sqrt(np.maximum(light.background_e[s], 0.0) + DARK_E2 + np.maximum(np.maximum(u, v), 0.0))[
                used
            ]
        )
        A = np.stack([u[used], v[used], np.ones(used.sum())], axis=1) * weight[:, None]
        covariance = np.linalg.inv(A.T @ A)
        expected = covariance @ A.T @ (residual[s][used] * weight)
        assert shares[:, i] == pytest.approx(expected[:2], rel=1e-6, abs=1e-6)
        left = (residual[s][used] * weight - A @ expected).astype(float)
        change_e = 0.5 * (light.background_e[s + 1].astype(float) - light.background_e[s - 1])
        by_background = covariance @ A.T @ (change_e[used] * weight)
        noise = max(left @ left / (used.sum() - 3.0), 1.0) * np.diag(covariance)
        assert variances[:, i] == pytest.approx((noise + by_background**2)[:2], rel=1e-4)


def gap_of(
    rng: np.random.Generator, ends: float, begins: float, floor_e: float, *, flipped: bool = False
) -> StripeLight:
    """A plate's stripe with a gap from line to line; at its bottom, if it is lit, it runs 20 px off."""
    s, r = np.arange(N_SCAN, dtype=float), np.arange(DEPTH, dtype=float)
    run = 35.3 + 0.1031 * (s - EDGE)
    plate, floor = (np.exp(-0.5 * ((r - at[:, None]) / WIDTH_PX) ** 2) for at in (run, run + 20.0))
    open_share = (ndtr((s - ends) / PSF_PX) - ndtr((s - begins) / PSF_PX))[:, None]
    mean = 3000.0 * (1.0 - open_share) * plate + floor_e * open_share * floor + 500.0
    deep = (s > ends) & (s < begins)
    position = np.where(deep, run + 20.0 if floor_e else np.nan, run)
    charge = rng.normal(mean, np.sqrt(mean + DARK_E2))
    if flipped:
        charge, position = charge[::-1], position[::-1]
    return light_of(rng, ends, begins)._replace(
        charge_e=np.ascontiguousarray(charge, dtype=np.float32), position_px=np.ascontiguousarray(position)
    )


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize(
    ("gap_lines", "floor_e"), [(3.4, 0.0), (7.0, 0.0), (16.3, 0.0), (7.0, 2000.0), (16.3, 2000.0)]
)
def test_a_gap_s_ends_are_where_the_plate_s_stripe_ends(
    gap_lines: float, floor_e: float, flipped: bool
) -> None:
    """A lit bottom is told from the plate where there are lines enough of it."""
    rng, off, stated = np.random.default_rng(7), [], []
    for _ in range(50):
        ends = EDGE - 6.0 + rng.uniform(-0.5, 0.5)
        begins = ends + gap_lines
        light = gap_of(rng, ends, begins, floor_e, flipped=flipped)
        last, first = math.floor(ends), math.ceil(begins)
        between, away = first - last - 1, -1 if flipped else 1
        for line, true, step in ((last, ends, away), (first, begins, -away)):
            found = stripe_end(light, N_SCAN - 1 - line if flipped else line, step, between)
            off.append((N_SCAN - 1 - found.line if flipped else found.line) - true)
            stated.append(found.sigma)
    print(
        f"gap {gap_lines}: rms {np.std(off):.3f} lines, mean {np.mean(off):.3f}, stated {np.mean(stated):.3f}"
    )
    assert np.std(off) < 0.1
    assert abs(np.mean(off)) < 0.05
    assert np.mean(np.square(np.array(off) / stated)) < 1.3


def test_an_end_may_lie_beyond_lines_that_were_not_read() -> None:
    """A shadow's border beneath the stripe hides a plate's last lines from the fit, and not their light."""
    light = gap_of(np.random.default_rng(9), 24.4, 44.0, 0.0)
    position = light.position_px.copy()
    position[20:25] = np.nan
    light = light._replace(position_px=position)
    assert stripe_end(light, 19, 1, 19, 5).line == pytest.approx(24.4, abs=0.2)
    assert math.isnan(stripe_end(light, 19, 1, 19).line)


def test_an_end_does_not_look_past_the_image() -> None:
    light = gap_of(np.random.default_rng(7), 20.0, 36.0, 0.0)
    assert stripe_end(light, 20, 1, 15).sigma < 0.2
    for last, away in ((0, -1), (N_SCAN - 1, 1)):
        assert not stripe_end(light, last, away, 15).sigma < 1.0


@settings(deadline=None, max_examples=30)
@given(
    st.floats(2.0, 6.0),
    st.floats(0.3, 1.5),
    st.floats(0.03, 0.3),
    st.floats(0.0, 0.9),
    st.sampled_from([0.0, 0.6, 3.0]),
    st.integers(0, 2**32 - 1),
)
def test_an_end_is_its_twin(
    true: float, sigma: float, contrast: float, correlation: float, seen_lines: float, seed: int
) -> None:
    rng, lines = np.random.default_rng(seed), np.arange(9.0)
    variance = rng.uniform(1e-4, 1e-3, 9)
    share = ndtr((true - lines) / sigma) + np.sqrt(variance) * rng.standard_normal(9)

    def misfit(at: float) -> float:
        return sum(parts(at))

    def parts(at: float) -> tuple[float, float]:
        """chi^2 and ln of the determinant by the whole covariance, with what lines share."""
        mean = ndtr((at - lines) / sigma)
        own = variance + MIN_STRIPE_SHARE**2 + (SPREAD * contrast) ** 2
        together = correlation ** np.abs(lines[:, None] - lines) + min(
            (1 + correlation) / (1 - correlation) / BEYOND, 1.0
        )
        covered = ndtr((at + seen_lines - lines) / sigma) - mean
        shine = np.hypot(SIDE_SHARE * (1.0 - mean), SEEN_SIDE_SHARE * covered)
        side = SIDE_CORRELATION ** np.abs(lines[:, None] - lines) * np.outer(shine, shine)
        covariance = np.diag(own) + contrast**2 * together * np.outer(mean, mean) + side
        off = share - mean
        return float(off @ np.linalg.solve(covariance, off)), float(np.linalg.slogdet(covariance)[1])

    read = LineShares(share, variance, contrast, correlation, seen_lines, sigma)
    for at in (true, true + 0.8):
        fit = end_misfit(read, at)
        assert fit.misfit == pytest.approx(misfit(at), rel=1e-6)
    places = np.arange(1.0, 7.0, 0.01)
    misfits = np.array([misfit(at) for at in places])
    weights = np.exp(-0.5 * (misfits - misfits.min()))
    mean = weights @ places / weights.sum()
    deviation = math.sqrt(weights @ (places - mean) ** 2 / weights.sum())
    end, end_sigma = fit_end(read, 1.0, 7.0)
    assert end == pytest.approx(mean, abs=0.5 * STEP)
    excess = max(parts(end)[0] / 7.0 - math.sqrt(2.0 / 7.0), 1.0)
    assert end_sigma == pytest.approx(math.hypot(math.sqrt(excess) * deviation, MIN_SIGMA), rel=0.2)


def test_no_end_lies_between_bounds_that_are_crossed() -> None:
    read = LineShares(np.linspace(1.0, 0.0, 9), np.full(9, 1e-3), 0.1, 0.0, 0.0, 1.0)
    assert np.isnan(fit_end(read, 5.0, 3.0)).all()


NO_CHANGE = EdgeScatter(0.0, 0.0)


def test_a_side_that_the_camera_sees_leaves_an_edge_less_sure() -> None:
    """It may mirror a stripe: more, the more of a line it covers."""
    profile = profile_of(light_of(np.random.default_rng(5), EDGE + 0.3, EDGE + 1.6))
    face = meet_face(profile.points, np.zeros(N_SCAN), np.zeros(N_SCAN))
    seen_mm = np.array([0.0, 0.5, 1.0, 3.0]) * profile.column_mm
    edges = [edge_amid(profile, EDGE, EDGE + 2, HiddenStrip(0.0, 0.0, mm), face) for mm in seen_mm]
    variances = [edge.variance_mm2 for edge in edges]
    assert variances[0] < variances[1] < variances[2] < variances[3] < 1.1 * variances[2]


def edge_of(profile: Profile, before: int, behind: int, hidden_mm: float) -> Edge:
    """The edge between two points of a profile whose faces lie at z = 0."""
    n = len(profile.y_mm)
    strip = HiddenStrip(hidden_mm, 0.0, 0.0)
    face = meet_face(profile.points, np.zeros(n), np.zeros(n))
    return edge_amid(profile, before, behind, strip, face)


def edge_amid(profile: Profile, before: int, behind: int, hidden: HiddenStrip, face: OnFace) -> Edge:
    edge: Edge = upright_edge(
        profile.scan,
        profile.column_mm,
        profile.light,
        before,
        behind,
        hidden,
        face,
        NO_CHANGE,
    )
    return edge


def test_an_edge_seen_from_beside_does_not_scatter_with_its_neighbours_centres() -> None:
    """A centre that is off moves its point along the ray; the scan line stays where the face has it."""
    light = light_of(np.random.default_rng(5), EDGE + 0.3, EDGE + 1.6)
    straight, rng = profile_of(light), np.random.default_rng(8)
    off_px = 2.0 * rng.standard_normal(N_SCAN)
    beside = replace(
        straight,
        y_mm=straight.y_mm + 0.15 * off_px,
        z_mm=straight.z_mm + 0.1 * off_px,
        dy_mm=np.full(N_SCAN, 0.15),
    )
    expected, seen = edge_of(straight, EDGE, EDGE + 2, 0.0), edge_of(beside, EDGE, EDGE + 2, 0.0)
    assert expected.y_per_z == 0.0
    assert seen.y_mm == pytest.approx(expected.y_mm, abs=1e-9)
    assert seen.variance_mm2 == pytest.approx(expected.variance_mm2)
    assert seen.y_per_z == pytest.approx(1.5)
    # A face that is believed 0.1 mm higher than it is moves the edge by that much of 0.1 mm.
    face = meet_face(beside.points, np.full(N_SCAN, 0.1), np.zeros(N_SCAN))
    higher = edge_amid(beside, EDGE, EDGE + 2, HiddenStrip(0.0, 0.0, 0.0), face)
    assert higher.y_mm - seen.y_mm == pytest.approx(0.15)
    covariance = edge_covariance(seen, np.array([1.0]), np.array([1.0]), np.array([[0.04]]))
    assert covariance - np.diag([seen.variance_mm2, 0.0]) == pytest.approx(
        np.array([[0.09, 0.06], [0.06, 0.04]])
    )


def test_a_ray_along_a_face_meets_it_nowhere_else() -> None:
    light = light_of(np.random.default_rng(5), EDGE + 0.3, EDGE + 1.6)
    profile = replace(profile_of(light), dy_mm=np.full(N_SCAN, 0.2), dz_mm=np.full(N_SCAN, 0.1))
    met = meet_face(profile.points, np.ones(N_SCAN), np.full(N_SCAN, 0.5))
    assert (met.y_mm == profile.y_mm).all()
    assert (met.y_per_z == 0.0).all()


@pytest.mark.parametrize(("hidden_mm", "foot_lines"), [(0.13, 1.3), (0.0, 0.6)])
def test_an_edge_is_where_the_stripes_end(hidden_mm: float, foot_lines: float) -> None:
    """Where nothing is hidden, the stripes end at the upright side's top and foot, as the camera sees it."""
    light = light_of(np.random.default_rng(5), EDGE + 0.3, EDGE + 0.3 + foot_lines)
    edge = edge_of(profile_of(light), EDGE, EDGE + 2, hidden_mm)
    blind = edge_of(replace(profile_of(light), light=NO_LIGHT), EDGE, EDGE + 2, hidden_mm)
    true = 0.03 if hidden_mm else 0.06
    assert edge.y_mm == pytest.approx(true, abs=0.01)
    assert edge.variance_mm2 < blind.variance_mm2
    assert blind.y_mm == pytest.approx(0.1 - 0.5 * hidden_mm)
    # Two points nearer to each other than their spacing tell no more than that.
    assert blind.variance_mm2 == pytest.approx(max(0.2 - hidden_mm, 0.1) ** 2 / 12.0)


def test_light_that_ends_elsewhere_is_no_edge() -> None:
    light = light_of(np.random.default_rng(5), EDGE + 3.4, EDGE + 3.4)
    profile = profile_of(light)
    assert edge_of(profile, EDGE, EDGE + 1, 0.0) == edge_of(
        replace(profile, light=NO_LIGHT), EDGE, EDGE + 1, 0.0
    )


def under_a_glint(light: StripeLight, first: int, last: int) -> StripeLight:
    """The light with no stripe read from line `first` to `last`, for pixels beside it are saturated."""
    censored, position_px = light.censored.copy(), light.position_px.copy()
    censored[first : last + 1, 20:30] = True
    position_px[first : last + 1] = math.nan
    return light._replace(censored=censored, position_px=position_px)


def test_no_share_is_read_under_a_glint() -> None:
    light = light_of(np.random.default_rng(5), EDGE + 0.3, EDGE + 1.6)
    hidden = profile_of(under_a_glint(light, EDGE + 1, EDGE + 1))
    blind = edge_of(replace(hidden, light=NO_LIGHT), EDGE, EDGE + 2, 0.0)
    assert edge_of(hidden, EDGE, EDGE + 2, 0.0) == blind
    assert edge_of(profile_of(light), EDGE, EDGE + 2, 0.0) != blind


def test_lines_with_hardly_any_of_a_plate_s_light_hold_none() -> None:
    """The optics throw a few percent of the stripe into a gap, where its centre is read all the same."""
    light = light_of(np.random.default_rng(5), 100.0, 200.0, contrast=0.1)
    gap, half_lit = slice(EDGE, EDGE + 5), EDGE + 5
    image_dn = (light.charge_e - 500.0) * np.ones((N_SCAN, 1), dtype=np.float32)
    image_dn[gap] *= 0.05
    image_dn[half_lit] *= 0.5
    profile = replace(profile_of(light), image_dn=np.rint(image_dn).astype(np.int64))
    on_plates = OnPlates(
        np.ones(N_SCAN, dtype=bool), meet_face(profile.points, profile.z_mm, np.zeros(N_SCAN))
    )
    sees = plate_lines(profile.seen_from(), on_plates, False, profile.image).sees
    assert (sees[gap] == UNREAD).all()
    assert (np.delete(sees, np.arange(EDGE, EDGE + 5)) == 1.0).all()
