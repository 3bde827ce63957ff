"""The seam as a curve, and what the tracker does not know of it."""

import numpy as np
import pytest

from tracker.seam.curve import (
    MIN_STRETCHES,
    POINT_SCATTER_MM,
    STRETCH_TURN,
    SYSTEMATIC_MM,
    SYSTEMATIC_SLOPE,
    SeamCurve,
    prior_covariance,
)


def tracked(y_of, sigma_mm=0.01, has_ridges=False):
    """The curve of a seam that was seen over a part of its stations."""
    stations = np.arange(30.0, 60.0, 1.5)
    displacements = np.column_stack([[y_of(station) for station in stations], np.full(len(stations), 0.2)])
    variances = np.full_like(displacements, sigma_mm**2)
    return SeamCurve.of(stations, displacements, variances, (0.0, 70.0), has_ridges)


def test_the_curve_runs_through_what_was_tracked():
    def y(station):
        return 0.8 * np.sin(2.0 * np.pi * station / 100.0)

    curve = tracked(y)
    (result, height), (slope, _) = curve.evaluate(np.zeros(curve.n_modes))
    inside = (curve.stations_mm >= 32.0) & (curve.stations_mm <= 58.0)
    np.testing.assert_allclose(result[inside], y(curve.stations_mm[inside]), atol=0.02)
    np.testing.assert_allclose(height, 0.2, atol=0.02)
    true_slope = 0.8 * 2.0 * np.pi / 100.0 * np.cos(2.0 * np.pi * curve.stations_mm / 100.0)
    np.testing.assert_allclose(slope[inside], true_slope[inside], atol=0.006)


def test_modes_are_small_where_the_seam_was_seen():
    curve = tracked(lambda station: 0.0)
    assert curve.sigma_mm(45.0)[0] < 0.5 * curve.sigma_mm(0.0)[0]


@pytest.mark.parametrize("length_mm", [70.0, 1000.0])
def test_modes_leave_nothing_of_the_seam_that_images_show(length_mm):
    """A frame's images show their seam to 2 um: what modes left out, an effect would have to explain."""
    seen = np.arange(10.0, length_mm, 2.5)
    of_point = np.full((len(seen), 2), 0.011**2)
    curve = SeamCurve.of(seen, np.zeros((len(seen), 2)), of_point, (0.0, length_mm), False)
    stations, middle = curve.stations_mm, 0.5 * (curve.stations_mm[0] + curve.stations_mm[-1])
    for axis, bend_mm in enumerate((1.0, 0.02)):
        prior, across, of_seen = (
            prior_covariance(x, other, middle, bend_mm)
            for x, other in ((stations, stations), (seen, stations), (seen, seen))
        )
        noise = np.diag(of_point[:, axis] + POINT_SCATTER_MM**2)
        covariance = prior - across.T @ np.linalg.solve(of_seen + noise, across)
        covariance += SYSTEMATIC_MM**2
        covariance += np.outer(stations - middle, stations - middle) * SYSTEMATIC_SLOPE**2
        left_mm2 = np.diag(covariance) - np.sum(curve.modes_mm[:, axis] ** 2, axis=0)
        assert np.sqrt(left_mm2.mean()) < 0.0021


def test_a_seam_that_was_never_seen_is_the_nominal_one_give_or_take():
    curve = SeamCurve.of(np.empty(0), np.empty((0, 2)), np.empty((0, 2)), (0.0, 50.0), False)
    np.testing.assert_array_equal(curve.mean_mm, 0.0)
    assert np.abs(curve.modes_mm[0]).max() > 1.0


@pytest.mark.slow
def test_stretches_are_tangents_and_more_where_it_turns():
    straight = tracked(lambda station: 0.1)
    bent = tracked(lambda station: 2e-3 * (station - 45.0) ** 2)
    none = np.zeros(straight.n_modes)
    assert len(straight.bent(none, 30.0, 60.0, 0.0).lines) == MIN_STRETCHES
    lines = bent.bent(none, 30.0, 60.0, 0.0).lines
    assert len(lines) > 2 * MIN_STRETCHES
    assert np.ptp([line.slope_y for line in lines]) <= STRETCH_TURN * (len(lines) + 1)
    # It is the seam that counts, not what of it the tracker saw: modes may bend it further.
    bends = np.linspace(0.0, 2.0, bent.n_modes)
    turned = bent.bent(bends, 30.0, 60.0, 0.0).lines
    slopes = bent.evaluate(bends)[1][0, (bent.stations_mm >= 30.0) & (bent.stations_mm <= 60.0)]
    assert len(turned) != len(lines)
    assert (len(turned) - 1) * STRETCH_TURN < np.ptp(slopes) <= len(turned) * STRETCH_TURN
    for line in lines:
        assert line.slope_y == pytest.approx(4e-3 * (line.station_mm - 45.0), abs=0.01)


def test_ridges_keep_stretches_from_turning_so_there_are_more_of_them():
    inclined = tracked(lambda station: 0.02 * station, has_ridges=True)
    lines = inclined.bent(np.zeros(inclined.n_modes), 30.0, 60.0, 0.0).lines
    assert np.diff([line.y_mm for line in lines]).max() < 0.11


def test_it_strays_as_far_as_a_parabola_leaves_its_chord():
    curve = tracked(lambda station: 2e-3 * (station - 45.0) ** 2)
    strays = curve.chord_deviation_mm(np.zeros(curve.n_modes), 55.0, 35.0)
    assert strays == pytest.approx(2e-3 * 10.0**2, rel=0.05)


def test_a_mode_of_its_own_moves_the_seam_by_its_coefficient():
    curve = tracked(lambda station: 0.0)
    lean = np.stack([0.1 * curve.stations_mm, np.full(len(curve.stations_mm), 0.5)])
    coefficients = np.zeros(curve.n_modes + 1)
    coefficients[0] = 2.0
    moved, slope = curve.with_modes(lean[np.newaxis]).evaluate(coefficients)
    np.testing.assert_allclose(moved - curve.mean_mm, 2.0 * lean)
    np.testing.assert_allclose(
        slope - np.gradient(curve.mean_mm, axis=1), [[0.2], [0.0]] + 0.0 * slope, atol=1e-12
    )
