"""A joint's fit on profiles of all kinds, which are drawn about a known seam."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from profiles import Profile, fit_joint, measure, rounded

from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import Joint, section
from tracker.joint.evidence import MIN_EVIDENCE_NATS
from tracker.joint.groove import PRIOR_SIGMA, mixture_of, outside_hidden_bevel
from tracker.pipeline import MAX_COVERED_MM
from tracker.profile import MIN_POINTS, in_scan_order
from tracker.state import SCAN

LINE = ((-100.0, 0.0, 0.0), (100.0, 0.0, 0.0))
CAMERA_MM, LASER_MM = np.array([60.0, 0.0, 130.0]), np.array([0.0, 0.0, 140.0])


def corners_of(joint: Joint) -> Float64:
    """A joint's section (n, 2), its seam point at 0, 0."""
    corners = section(joint).vertices.copy()
    corners[:, 1] += joint.dimensions.get("depth_mm", 0.0)
    return corners


def seam_of(seed: int) -> float:
    """The y of a profile's seam, mm."""
    return float(np.random.default_rng([seed, 1]).uniform(-2.0, 2.0))


def some_profile(joint: Joint, seed: int) -> Profile:
    """What a sensor may see of a joint: all of it, one side or no root, with spatter, lines out of order."""
    rng = np.random.default_rng(seed)
    seam = seam_of(seed), -4.0
    hidden_mm = (None, (0.2, rng.uniform(1.0, 6.0)), (-rng.uniform(1.0, 6.0), -0.2), (-0.6, 0.6))[seed % 4]
    sigma_px = rng.uniform(0.05, 0.4)
    profile = measure(corners_of(joint), seam, rng, sigma_px=sigma_px, hidden_mm=hidden_mm)
    n = len(profile.y_mm)
    z_mm, scan = profile.z_mm.copy(), profile.scan.copy()
    z_mm[rng.random(n) < 0.03 + 0.3 * (seed % 5 == 4)] += 2.0
    if seed % 3 == 1:
        k = int(rng.integers(n - 1))
        scan[k], scan[k + 1] = scan[k + 1], scan[k]
    seen = replace(profile, z_mm=z_mm, scan=scan, mixed_mm=0.2 * (seed % 2))
    if seed % 3 < 2:
        return seen
    # Of lines half as far apart some are read two by two, and of others every second one.
    n_lines = rng.integers(1, 3, n).astype(float)
    return replace(
        seen,
        scan=2.0 * scan + 0.5 * (n_lines - 1.0),
        column_mm=0.5 * profile.column_mm,
        n_lines=n_lines,
        misfit_px=np.abs(rng.normal(0.0, 0.1, n)),
    )


def a_v(gap_mm: float) -> Joint:
    return Joint("v_groove", {"included_angle_deg": 60.0, "depth_mm": 4.0, "root_gap_mm": gap_mm}, LINE)


A_U = Joint(
    "u_groove", {"depth_mm": 7.0, "root_radius_mm": 2.0, "bevel_angle_deg": 12.0, "root_gap_mm": 1.0}, LINE
)


def a_half_v(gap_mm: float) -> Joint:
    return Joint("half_v", {"bevel_angle_deg": 45.0, "depth_mm": 4.0, "root_gap_mm": gap_mm}, LINE)


JOINTS = [
    *(a_v(0.0), a_v(0.3), a_v(1.2), A_U, a_half_v(0.0), a_half_v(0.3), a_half_v(1.5)),
    *(Joint("fillet", {"included_angle_deg": angle_deg}, LINE) for angle_deg in (70.0, 120.0, 270.0)),
]


EDGED = [
    *(a_v(0.0), a_v(1.0), a_half_v(1.5), A_U, Joint("lap", {"thickness_mm": 2.0}, LINE)),
    Joint("butt", {"gap_mm": 1.5, "thickness_mm": 4.0}, LINE),
    Joint("outside_corner", {"included_angle_deg": 90.0}, LINE),
]


@pytest.mark.parametrize("joint", JOINTS, ids=str)
def test_a_joint_lies_where_its_profile_was_drawn(joint: Joint) -> None:
    """Of spattered and half hidden profiles too, with lines out of order or read two by two."""
    off_sigmas = []
    for seed in range(40):
        found = fit_joint(some_profile(joint, seed), joint, CAMERA_MM, LASER_MM)
        if found is not None:
            off_mm = found.y_mm - seam_of(seed)
            off_sigmas.append(off_mm / np.sqrt(found.covariance_mm2[0, 0]))
    print(f"{len(off_sigmas)} of 40, {np.sort(np.abs(off_sigmas))[-6:]}")
    assert len(off_sigmas) > 20
    assert np.median(np.abs(off_sigmas)) < 1.2
    assert np.mean(np.abs(off_sigmas) < 4.0) >= 0.9


@pytest.mark.parametrize("gap_mm", [0.0, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("is_mirrored", [False, True])
def test_a_t_joint_lies_where_its_plates_faces_meet(gap_mm: float, is_mirrored: bool) -> None:
    """Whichever plate stands off the other, stated or not; a gap that is none is not reported."""
    size = {"included_angle_deg": 90.0}
    corners = section(Joint("fillet", size | {"gap_mm": gap_mm}, LINE)).vertices
    if is_mirrored:
        corners = np.ascontiguousarray(corners[::-1] * [-1.0, 1.0])
    for stated in ({}, {"gap_mm": 1.5}):
        for seed in range(8):
            rng = np.random.default_rng(seed)
            profile = measure(corners, (seam_of(seed), -4.0), rng, sigma_px=0.2)
            found = fit_joint(profile, Joint("fillet", size | stated, LINE), CAMERA_MM, LASER_MM)
            assert found is not None
            assert abs(found.y_mm - seam_of(seed)) < 4.0 * np.sqrt(found.covariance_mm2[0, 0])
            assert found.misfit_nats < MIN_EVIDENCE_NATS
            if gap_mm > 0.0:
                assert found.gap_mm == pytest.approx(gap_mm, abs=4.0 * found.shape.gap_sigma_mm)
                assert found.shape.gap_sigma_mm < 0.15
                # The foot's end is a corner of the section, a vertical step beside the seam.
                assert abs(found.corners_mm[1, 0] - found.y_mm) == pytest.approx(
                    gap_mm / np.sqrt(2.0), abs=0.3
                )
            else:
                assert np.isnan(found.gap_mm) if not stated else found.gap_mm < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("radius_mm", [0.0, 0.25, 0.5, 1.0])
@pytest.mark.parametrize("joint", EDGED, ids=str)
def test_a_joint_of_rounded_edges_is_as_sure_as_what_is_seen_of_them(joint: Joint, radius_mm: float) -> None:
    """An edge is where faces would meet; a rounding that hides it widens the sigma, or loses the joint."""
    corners, pulls = rounded(corners_of(joint), radius_mm), []
    for seed in range(30):
        rng, sigma_px = np.random.default_rng([seed, 5]), (0.1, 0.4, 1.0)[seed % 3]
        profile = measure(corners, (seam_of(seed), -4.0), rng, sigma_px=sigma_px)
        found = fit_joint(profile, joint, CAMERA_MM, LASER_MM)
        if found is not None and found.covered_mm <= MAX_COVERED_MM:
            off_mm = np.subtract((found.y_mm, found.z_mm), (seam_of(seed), -4.0))
            pulls.append(off_mm / np.sqrt(np.diag(found.covariance_mm2)))
    error_over_sigma = np.sqrt(np.mean(np.square(pulls), axis=0))
    print(f"{len(pulls)} of 30, error/sigma {error_over_sigma}")
    assert np.abs(pulls).max() < 5.0
    assert (error_over_sigma < 1.6).all()
    # A butt's rounding has no foot: half a millimetre is taken for the gap's.
    assert len(pulls) == 30 or (joint.type == "butt" and radius_mm >= 0.5)


def test_a_mixture_has_the_mean_and_covariance_of_its_normals() -> None:
    rng = np.random.default_rng(3)
    means, nats = rng.normal(size=(4, 3)), np.array([-3.0, -2.0, -np.inf, -2.5])
    roots = rng.normal(size=(4, 3, 3))
    covariances = roots @ roots.transpose(0, 2, 1)
    held = np.array([0, 1, 3])
    mean, covariance = mixture_of(nats[held], means[held], covariances[held])
    shares = np.exp(nats[[0, 1, 3]]) / np.exp(nats).sum()
    kept, within = means[[0, 1, 3]], covariances[[0, 1, 3]]
    np.testing.assert_allclose(mean, shares @ kept, rtol=1e-12)
    second = np.einsum("k,kij->ij", shares, within + kept[:, :, None] * kept[:, None, :])
    np.testing.assert_allclose(covariance, second - np.outer(mean, mean), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_points_that_count_where_a_bevel_is_hidden(side: float) -> None:
    y, start = np.linspace(-9.0, 9.0, 181), np.zeros(9)
    start[2] = 1.4
    out, sure_mm = side * (y - 0.31), start[2] - 2.0 * PRIOR_SIGMA[2]
    counts = outside_hidden_bevel(out, np.array([0.31, -4.0, 1.2]), sure_mm, 3.0)
    np.testing.assert_array_equal(counts, (out + 0.6 < 1.4 - 2.0 * PRIOR_SIGMA[2]) | (out > 4.0))
    assert 0 < counts.sum() < 181


@pytest.mark.parametrize("rises", [True, False])
def test_points_are_put_in_order_as_a_profile_is(rises: bool) -> None:
    profile = some_profile(a_v(1.0), 2)
    rng = np.random.default_rng(1)
    scan = profile.scan if rises else profile.scan[::-1].copy()
    middle = slice(5, -5)
    scan[middle] = rng.permutation(scan[middle])
    shuffled = replace(profile, scan=scan)
    order = np.argsort(scan if rises else -scan, kind="stable")
    ordered, twin = in_scan_order(shuffled.points), shuffled.points[:, order]
    assert (np.diff(ordered[SCAN]) > 0.0).all() if rises else (np.diff(ordered[SCAN]) < 0.0).all()
    np.testing.assert_array_equal(ordered, twin)


@pytest.mark.parametrize(
    "joint", [a_v(1.0), A_U, a_half_v(1.0), Joint("lap", {"thickness_mm": 2.0}, LINE)], ids=str
)
def test_too_few_points_determine_no_joint(joint: Joint) -> None:
    profile, n = some_profile(joint, 0), MIN_POINTS - 1
    names = ("y_mm", "z_mm", "dy_mm", "dz_mm", "sigma_px", "scan", "beside_px")
    short = replace(profile, **{name: getattr(profile, name)[:n].copy() for name in names})
    assert fit_joint(short, joint, CAMERA_MM, LASER_MM) is None
