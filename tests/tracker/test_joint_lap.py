"""The lap on profiles cut from known sections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import COLUMN_MM, PX_MM, fit_joint, lap, measure, only, spoil

from noise_model.surface.joint import Joint
from tracker.joint import MeasuredJoint
from tracker.joint.common_mode import BIAS_SHARE, COMMON_MODE_PX
from tracker.joint.lap import CLEAR_OF_EDGE_MM, SheetLines, sheets_at
from tracker.joint.section_fit import SIGMA_FLOOR_PX
from tracker.joint.upright_edge import (
    Edge,
    edge_covariance,
    hidden_strip,
    neighbours_of_edge,
    points_around_edge,
)

LINE = ((-100.0, 0.0, 0.0), (100.0, 0.0, 0.0))
STATED = Joint("lap", {"thickness_mm": 2.0}, LINE)
CAMERA_MM, LASER_MM = np.array([-55.0, 0.0, 135.0]), np.array([0.0, 0.0, 140.0])
TRUE_SIGMA_PX = float(np.hypot(0.05, SIGMA_FLOOR_PX))


def fit(profile, camera_mm: np.ndarray = CAMERA_MM, laser_mm: np.ndarray = LASER_MM) -> MeasuredJoint | None:
    return fit_joint(profile, STATED, camera_mm, laser_mm)


@pytest.mark.parametrize("seam", [(0.0, 0.0), (4.3, -1.0), (-5.1, 1.5)])
@pytest.mark.parametrize(("step", "slopes"), [(2.0, (0.0, 0.0)), (2.4, (0.02, 0.0)), (2.1, (-0.01, 0.02))])
def test_an_exact_lap_is_read_exactly(
    seam: tuple[float, float], step: float, slopes: tuple[float, float]
) -> None:
    above = np.array([0.0, seam[0], 0.0])
    profile = measure(lap(step, *slopes), seam, np.random.default_rng(0), noise=False)
    found = fit(profile, CAMERA_MM + above, LASER_MM + above)
    assert found is not None
    assert found.y_mm == pytest.approx(seam[0], abs=0.5 * COLUMN_MM + 1e-6)
    assert found.z_mm == pytest.approx(seam[1], abs=0.005)
    assert found.gap_mm == pytest.approx(step - 2.0, abs=0.01)
    assert found.mismatch_mm == pytest.approx(-step, abs=0.01)
    assert found.chi2 < 0.05


@pytest.mark.parametrize("tangent", [-0.15, 0.1, 0.15])
def test_a_rolled_lap_is_placed_by_its_step(tangent: float) -> None:
    profile = measure(lap(2.0, tangent, tangent), (1.3, 0.2), np.random.default_rng(2))
    found = fit(profile)
    assert found is not None
    assert found.y_mm == pytest.approx(1.3, abs=COLUMN_MM)
    np.testing.assert_allclose(np.tan(np.radians(found.shape.plate_angles_deg)), tangent, atol=0.002)


@pytest.mark.parametrize("slopes", [(0.1, 0.1), (0.05, -0.03)])
def test_its_section_lies_on_its_sheets(slopes: tuple[float, float]) -> None:
    profile = measure(lap(2.0, *slopes), (1.33, 0.2), np.random.default_rng(2))
    found = fit(profile)
    assert found is not None
    y, z = found.corners_mm.T
    clear = np.abs(profile.y_mm - found.y_mm) > CLEAR_OF_EDGE_MM
    off = (profile.z_mm - np.interp(profile.y_mm, y, z))[clear]
    assert abs(off[profile.y_mm[clear] < found.y_mm].mean()) < 0.001
    assert abs(off[profile.y_mm[clear] > found.y_mm].mean()) < 0.001


@pytest.mark.parametrize("y_mm", [-20.0, -40.0, -180.0])
def test_what_the_edge_hides_does_not_move_the_foot(y_mm: float) -> None:
    camera, laser = np.array([0.0, y_mm, 135.0]), np.array([0.0, y_mm / 2.0, 140.0])
    strip = max(-source[1] / (source[2] - 2.0) * 2.0 for source in (camera, laser))
    rng = np.random.default_rng(1)
    found = fit(measure(lap(2.0), (0.0, 0.0), rng, hidden_mm=(0.0, strip)), camera, laser)
    assert found is not None
    assert strip > 3.0 * COLUMN_MM
    assert found.y_mm == pytest.approx(0.0, abs=COLUMN_MM)
    assert found.z_mm == pytest.approx(0.0, abs=0.01)


def test_its_covariance_is_honest() -> None:
    rng = np.random.default_rng(20)
    errors, scaled, chi2 = [], [], []
    for _ in range(400):
        seam = (rng.uniform(-1.0, 1.0), 0.5)
        profile = measure(lap(2.2, 0.01, -0.01), seam, rng, sigma_px=TRUE_SIGMA_PX, common_px=COMMON_MODE_PX)
        profile.sigma_px[:] = 0.05
        above = np.array([0.0, seam[0], 0.0])
        found = fit(profile, CAMERA_MM + above, LASER_MM + above)
        assert found is not None
        errors.append((found.y_mm - seam[0], found.z_mm - seam[1]))
        scaled.append(np.square(errors[-1]) / np.diag(found.covariance_mm2))
        chi2.append(found.chi2)
    scatter = np.std(errors, axis=0)
    print(
        f"lap: rms {scatter} mm, mean {np.mean(errors, axis=0)}, chi2 of y, z {np.mean(scaled, axis=0)}, "
        f"of the fit {np.mean(chi2):.3f}"
    )
    assert ((np.mean(scaled, axis=0) > 0.75) & (np.mean(scaled, axis=0) < 1.25)).all()
    assert (np.abs(np.mean(errors, axis=0)) < 4.0 * scatter / np.sqrt(len(errors))).all()


def test_a_correction_of_the_centres_is_known_to_a_share() -> None:
    """All centres near the seam may be off by it alike; what was corrected far off does not count."""
    profile = measure(lap(2.2, 0.0, 0.0), (0.3, 0.2), np.random.default_rng(0))
    near = np.abs(profile.y_mm - 0.3) < 3.0
    known = fit(profile)
    assert known is not None
    for bias_px, share in ((np.where(near, -0.8, 0.0), BIAS_SHARE), (np.where(near, 0.0, 2.0), 0.0)):
        corrected = fit(replace(profile, bias_px=bias_px))
        assert corrected is not None
        off_mm = 0.8 * share * np.array(PX_MM)
        np.testing.assert_allclose(
            corrected.covariance_mm2 - known.covariance_mm2, np.outer(off_mm, off_mm), atol=1e-9
        )


def test_three_wrong_points_in_ten_do_not_move_it() -> None:
    rng = np.random.default_rng(3)
    errors = []
    for _ in range(60):
        found = fit(spoil(measure(lap(2.0), (0.0, 0.0), rng), 0.3, rng))
        assert found is not None
        errors.append((found.y_mm, found.z_mm))
    errors = np.abs(errors)
    print(
        f"lap, 30 % outliers: 90 % below {np.quantile(errors, 0.9, axis=0)}, largest {errors.max(axis=0)} mm"
    )
    assert errors[:, 1].max() < 0.02
    assert np.quantile(errors[:, 0], 0.9) < 0.25
    assert errors[:, 0].max() < 0.5


@pytest.mark.parametrize("kept", ["upper", "lower", "no edge", "upper and a little"])
def test_half_a_lap_is_none_or_says_how_unsure_it_is(kept: str) -> None:
    rng = np.random.default_rng(4)
    for _ in range(10):
        whole = measure(lap(2.0), (0.0, 0.0), rng)
        seen = {
            "upper": whole.y_mm < 0.0,
            "lower": whole.y_mm > 0.0,
            "no edge": np.abs(whole.y_mm) > 1.5,
            "upper and a little": whole.y_mm < 0.5,
        }[kept]
        found = fit(only(whole, seen))
        if found is not None:
            sigma = np.sqrt(np.diag(found.covariance_mm2))
            assert (np.abs([found.y_mm, found.z_mm]) < 5.0 * sigma + 0.02).all(), kept


@pytest.mark.parametrize(("beside_mm", "is_seen"), [(0.3, True), (0.5, False)])
def test_an_edge_that_glare_hides_is_none(beside_mm: float, is_seen: bool) -> None:
    rng = np.random.default_rng(6)
    found = fit(measure(lap(2.0), (0.0, 0.0), rng, hidden_mm=(-beside_mm, beside_mm)))
    assert (found is not None) == is_seen
    assert found is None or abs(found.y_mm) < beside_mm


def test_a_flat_plate_is_no_lap() -> None:
    rng = np.random.default_rng(6)
    for _ in range(10):
        found = fit(measure(np.array([(-60.0, 0.0), (60.0, 0.0)]), (0.0, 0.0), rng))
        assert found is None or found.chi2 > 9.0


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40))
def test_an_edges_neighbours_are_their_twins(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    which = rng.integers(0, 3, n)
    before, behind = which == 0, which == 1
    found = neighbours_of_edge(before, behind)
    # A change at each place: who stands on his own side of it, and who does not.
    right = [before[: i + 1].sum() - behind[: i + 1].sum() for i in range(n)]
    best = np.flatnonzero(np.array(right) == max(right))
    last = np.flatnonzero(before[: best[0] + 1])
    first = np.flatnonzero(behind[best[-1] + 1 :]) + best[-1] + 1
    assert found == ((last[-1], first[0]) if len(last) and len(first) else (-1, -1))


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_what_lies_on_which_sheet_is_its_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    profile = spoil(measure(lap(2.1, 0.01, -0.02), (0.3, 0.2), rng), 0.1, rng)
    y, z = profile.y_mm, profile.z_mm
    sheets = SheetLines(float(rng.uniform(-1.0, 1.0)), 0.2, 2.1, 0.01, -0.02)
    faces = sheets_at(y, sheets)
    upper_mm, lower_mm = np.polyval([-0.02, 2.3], y - sheets.y), np.polyval([0.01, 0.2], y - sheets.y)
    np.testing.assert_allclose((faces.before_mm, faces.behind_mm), (upper_mm, lower_mm))
    np.testing.assert_array_equal(faces.before_slope, -0.02)
    np.testing.assert_array_equal(faces.behind_slope, 0.01)
    off_upper, off_lower = np.abs(z - upper_mm), np.abs(z - lower_mm)
    near = np.abs(y - sheets.y) < 2.0
    limits_mm = np.where(near, rng.uniform(0.05, 0.6, len(y)), 0.0)
    beside = points_around_edge(profile.points, faces, limits_mm)
    assert beside == neighbours_of_edge(off_upper < limits_mm, off_lower < limits_mm)


def test_an_edges_covariance_is_its_twin() -> None:
    rng = np.random.default_rng(8)
    between, there, root = rng.normal(size=4), rng.normal(size=4), rng.normal(size=(4, 4))
    edge, of_faces = Edge(0.3, 0.02, -0.7), root @ root.T
    moved = np.array([edge.y_per_z * between, there])
    want = moved @ of_faces @ moved.T + np.diag([edge.variance_mm2, 0.0])
    np.testing.assert_allclose(edge_covariance(edge, between, there, of_faces), want, rtol=1e-12)


def test_an_edge_hides_what_its_shadow_covers() -> None:
    # A ray from (-4, 12) over the edge at (1, 2) falls 10 mm on its way 5 mm to the right: half of that.
    beside, opposite, below = (
        np.array(eye) for eye in ([7.0, -4.0, 12.0], [7.0, 4.0, 12.0], [7.0, -4.0, 2.0])
    )
    assert hidden_strip((beside, opposite), 1.0, 2.0, 2.0, 0.0) == pytest.approx((1.0, 0.0, 0.0))
    assert hidden_strip((opposite,), 1.0, 2.0, 2.0, 0.0) == pytest.approx((0.0, 0.0, 0.6))
    assert hidden_strip((beside, below), 1.0, 2.0, 2.0, 0.1).width_mm == np.inf


@pytest.mark.parametrize(("y_mm", "x_mm"), [(-4.0, 30.0), (0.9, -60.0), (2.0, 40.0)])
def test_what_an_edge_hides_is_as_unsure_as_the_seams_slope(y_mm: float, x_mm: float) -> None:
    """Rays are followed over edges of many slopes: they pass the edge where it lies aside."""
    slope_sigma, over_mm, step_mm = 0.05, 90.0, 3.0
    slopes = slope_sigma * np.random.default_rng(2).standard_normal(400_000)
    # The ray to the lower side at x = 0 passes the edge's height at x_mm step / (over + step).
    edge_mm = 1.0 + slopes * x_mm * step_mm / (over_mm + step_mm)
    foot_mm = edge_mm + (edge_mm - y_mm) / over_mm * step_mm
    widths = np.maximum(foot_mm - 1.0, 0.0)
    told = hidden_strip((np.array([x_mm, y_mm, over_mm]),), 1.0, 0.0, step_mm, slope_sigma)
    assert told[:2] == pytest.approx((widths.mean(), widths.std()), rel=0.05, abs=1e-3)
