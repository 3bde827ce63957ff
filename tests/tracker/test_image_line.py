"""The seam's line in the image, drawn by hand: where it is read, how far it is off, when it is not told."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rendered import small_setup

from noise_model.arc.scene import Scene, make_scene
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.transforms import invert, transform
from tracker.geometry import SensorGeometry
from tracker.joint import fit_closed_joint
from tracker.joint.evidence import MIN_EVIDENCE_NATS
from tracker.joint.image_line import (
    CLIP_SIGMAS,
    CODE_SIGMA_DN,
    MAD_SIGMA,
    ImageLine,
    _middle,
    average_columns,
    read_image_line,
    sum_along,
    whiten,
)
from tracker.profile import Section, lines_of, triangulate
from tracker.state import Stripe
from tracker.stripe.expected import expect_stripe

PLATE_DN, NOISE_DN = 60.0, 2.0
REACH_MM = 5.0
seeds = st.integers(0, 2**32 - 1)


class Bench(NamedTuple):
    """A sensor over a flat plate, and the stripe that it shows there."""

    geometry: SensorGeometry
    scene: Scene
    path_px: Float64
    sigma_px: float
    section: Section

    def read(self, image: Float64, arc_burns: bool = False) -> ImageLine | None:
        """Read a drawn image, rounded to codes."""
        codes = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        by_line = codes.T if self.geometry.along_rows else codes
        given = self.geometry, self.scene, self.path_px, self.sigma_px, self.section, by_line, arc_burns
        return read_image_line(*given)


def bench_of(setup: Setup) -> Bench:
    geometry = SensorGeometry.of(setup)
    scene = make_scene(setup, np.eye(4))
    expected = expect_stripe(geometry, scene)
    assert expected is not None
    sigma, none = np.full(geometry.n_scan, 0.1), np.zeros(geometry.n_scan)
    stripe = Stripe(expected.position_px, sigma, sigma, none > 0.0, geometry.along_rows, sigma)
    lines = lines_of(stripe, none)
    points, column_mm, _, _ = triangulate(geometry.stripe_source, scene, lines)
    section = Section(points, column_mm, REACH_MM)
    return Bench(geometry, scene, expected.position_px, float(np.median(expected.sigma_px)), section)


def closed_butt() -> Setup:
    setup = small_setup("butt")
    return replace(setup, joint=replace(setup.joint, dimensions={"gap_mm": 0.1, "thickness_mm": 4.0}))


@pytest.fixture(scope="module")
def bench() -> Bench:
    return bench_of(closed_butt())


def plate(bench: Bench, rng: np.random.Generator) -> Float64:
    """A plate in dim light, with its sensor's noise."""
    camera = bench.geometry.setup.camera
    return PLATE_DN + NOISE_DN * rng.normal(size=(camera.height, camera.width))


def drawn(
    bench: Bench, y_mm: float, turn_deg: float, radius_mm: float, dark_dn: float, rim_dn: float = 0.0
) -> Float64:
    """A seam's slit, 1 px wide, and the rim beside it, DN: a circle through y at the sheet, joint frame."""
    camera = bench.geometry.setup.camera
    plane = bench.geometry.setup.laser.plane
    at_sheet = -(plane[3] + plane[1] * y_mm) / plane[0]
    s = np.linspace(-40.0, 40.0, 4001)
    turn = math.tan(math.radians(turn_deg))
    points = np.column_stack([at_sheet + s, y_mm + turn * s + 0.5 * s * s / radius_mm, np.zeros(len(s))])
    seen = camera.project(transform(invert(camera.T_tool_camera), points))
    order = np.argsort(seen[:, 1] if bench.geometry.along_rows else seen[:, 0])
    across, beside = (seen[order, 0], seen[order, 1]) if bench.geometry.along_rows else seen[order].T[::-1]
    n_beside = camera.height if bench.geometry.along_rows else camera.width
    n_across = camera.width if bench.geometry.along_rows else camera.height
    line = np.interp(np.arange(n_beside), beside, across, left=-1e3, right=-1e3)
    off = np.arange(n_across)[:, None] - line
    light = -dark_dn * np.exp(-0.5 * off**2) + rim_dn * np.exp(-0.5 * (off - 2.0) ** 2)
    return light.T if bench.geometry.along_rows else light


def test_a_slit_is_read_where_it_meets_the_stripe_within_its_sigma(bench: Bench) -> None:
    pulls, sigmas = [], []
    for n in range(24):
        rng = np.random.default_rng(n)
        y, turn = rng.uniform(-3.0, 3.0), rng.uniform(-6.0, 6.0)
        radius = rng.choice([-1.0, 1.0]) * rng.uniform(150.0, 1000.0)
        line = bench.read(plate(bench, rng) + drawn(bench, y, turn, radius, 6.0))
        assert line is not None
        assert line.evidence_nats > MIN_EVIDENCE_NATS
        pulls.append((line.y_mm - y) / line.sigma_mm)
        sigmas.append(line.sigma_mm)
    assert np.mean(np.square(pulls)) < 1.3, pulls
    assert max(sigmas) < 1.5 * bench.section.column_mm


def test_a_slit_round_a_nominal_circle_is_read_within_its_sigma() -> None:
    """The line leaves its tangent by 1.8 mm within reach, which no straight line shows."""
    radius_mm, pulls = 40.0, []
    setup = closed_butt()
    at_sheet = -setup.laser.plane[3] / setup.laser.plane[0]
    angles = np.radians(np.arange(-60.0, 60.1, 0.5))
    points = np.column_stack(
        [at_sheet + radius_mm * np.sin(angles), radius_mm * (1.0 - np.cos(angles)), 0.0 * angles]
    )
    nominal = tuple((float(x), float(y), float(z)) for x, y, z in points)
    turning = bench_of(replace(setup, joint=replace(setup.joint, seam_in_base_mm=nominal)))
    for n in range(12):
        rng = np.random.default_rng(n)
        y, turn = rng.uniform(-1.0, 1.0), rng.uniform(-3.0, 3.0)
        line = turning.read(plate(turning, rng) + drawn(turning, y, turn, radius_mm - y, 6.0))
        assert line is not None
        assert line.evidence_nats > MIN_EVIDENCE_NATS
        pulls.append((line.y_mm - y) / line.sigma_mm)
    assert np.mean(np.square(pulls)) < 1.3, pulls


def test_a_rim_beside_the_slit_does_not_pull_the_seam_to_its_plate(bench: Bench) -> None:
    pulls = []
    for n in range(12):
        rng = np.random.default_rng(n)
        line = bench.read(plate(bench, rng) + drawn(bench, 0.7, 3.0, 400.0, 6.0, rim_dn=8.0))
        assert line is not None
        pulls.append((line.y_mm - 0.7) / line.sigma_mm)
    assert np.mean(np.square(pulls)) < 1.5, pulls


def test_while_an_arc_burns_a_slit_is_read_and_a_bright_streak_is_not(bench: Bench) -> None:
    """Spatter adds light, and its streaks point away from the arc, as the seam does."""
    pulls = []
    for n in range(12):
        rng = np.random.default_rng(n)
        streak = -drawn(bench, rng.uniform(-2.0, 2.0), rng.uniform(-5.0, 5.0), 1e6, 30.0)
        alone = bench.read(plate(bench, rng) + streak, arc_burns=True)
        assert alone is None or alone.evidence_nats < MIN_EVIDENCE_NATS
        told = bench.read(plate(bench, rng) + streak)
        assert told is not None
        assert told.evidence_nats > MIN_EVIDENCE_NATS
        slit = drawn(bench, 0.7, 3.0, 400.0, 6.0)
        line = bench.read(plate(bench, rng) + slit + (streak if n % 2 else 0.0), arc_burns=True)
        assert line is not None
        assert line.evidence_nats > MIN_EVIDENCE_NATS
        pulls.append((line.y_mm - 0.7) / line.sigma_mm)
    assert np.mean(np.square(pulls)) < 1.5, pulls


def test_while_an_arc_burns_the_flank_of_a_bright_rim_is_not_surely_a_slit(bench: Bench) -> None:
    """A rim that shines between two plates that shine unlike: beside it a column lies below its median."""
    pulls, axis = [], 1 if bench.geometry.along_rows else 0
    for n in range(12):
        rng = np.random.default_rng(n)
        rim = -drawn(bench, 0.7, 3.0, 400.0, 20.0)
        border = 8.0 * np.cumsum(rim, axis=axis) / (20.0 * math.sqrt(2.0 * math.pi))
        line = bench.read(plate(bench, rng) + rim + border, arc_burns=True)
        assert line is not None
        pulls.append((line.y_mm - 0.7) / line.sigma_mm)
    assert np.abs(pulls).max() < 2.0, pulls


def test_a_rim_alone_stands_for_the_slit_and_says_how_unsure_it_is() -> None:
    """Dark beside a rim is the slit, or the plate's texture, or may be either."""
    x = np.arange(-3, 4)
    rim, slit = np.exp(-0.5 * (x + 1.0) ** 2), np.exp(-0.5 * (x - 2.0) ** 2)
    places, sigmas = [], []
    for dark in (0.0, 2.0, 7.0, 20.0):
        middle, variance = _middle(20.0 * rim - dark * slit)
        places.append(middle)
        sigmas.append(math.sqrt(variance))
    assert places[0] == pytest.approx(-1.0, abs=0.1)
    assert places[1] == pytest.approx(-1.0, abs=0.1)
    assert -0.5 < places[2] < 1.5
    assert sigmas[2] > 1.2 > max(sigmas[0], sigmas[3])
    assert places[3] == pytest.approx(2.0, abs=0.3)
    # A section that shows neither tells nothing.
    assert _middle(np.full(7, -1.0)) == pytest.approx((0.0, 4.0))


@pytest.mark.slow
def test_a_plate_without_a_seam_shows_no_line(bench: Bench) -> None:
    """Plain, brushed along and across the seam, and with an edge askew to it or a glare in view."""
    told = 0
    for n in range(40):
        rng = np.random.default_rng(n)
        image = plate(bench, rng)
        brushed = rng.normal(size=image.shape)
        along = np.cumsum(brushed, axis=n % 2)
        along[30:] -= along[:-30].copy()
        v, u = np.mgrid[: image.shape[0], : image.shape[1]]
        askew = math.radians(rng.uniform(25.0, 155.0))
        away = (u - 160.0) * math.cos(askew) + (v - 120.0) * math.sin(askew)
        edge = np.where(away > rng.uniform(-30.0, 30.0), 30.0, 0.0)
        glare = 150.0 * np.exp(-0.5 * (((u - 160.0) / 60.0) ** 2 + ((v - 240.0) / 80.0) ** 2))
        for texture in (np.zeros_like(image), 0.7 * along, edge, glare):
            line = bench.read(image + texture)
            told += line is not None and line.evidence_nats >= MIN_EVIDENCE_NATS
    assert told == 0


def test_two_lines_alike_tell_no_seam(bench: Bench) -> None:
    rng = np.random.default_rng(1)
    image = plate(bench, rng) + drawn(bench, -2.0, 0.0, 1e6, 8.0) + drawn(bench, 2.0, 0.0, 1e6, 8.0)
    line = bench.read(image)
    assert line is None or line.evidence_nats <= 0.0


def test_what_stands_on_the_stripe_alone_is_no_line(bench: Bench) -> None:
    """A notch in the stripe itself, or spatter there, is left out with the stripe."""
    rng = np.random.default_rng(2)
    image = plate(bench, rng)
    lines = np.arange(len(bench.path_px))
    at = np.rint(bench.path_px).astype(int)
    for away in range(-3, 4):
        place = (at + away, lines) if bench.geometry.along_rows else (lines, at + away)
        image[place] = np.where(np.abs(lines - 80) < 3, 20.0, 250.0)
    line = bench.read(image)
    assert line is None or line.evidence_nats < MIN_EVIDENCE_NATS


def test_a_closed_joint_lies_on_its_plates(bench: Bench) -> None:
    joint = bench.geometry.setup.joint
    measured = fit_closed_joint(bench.section, joint, ImageLine(1.2, 0.1, 40.0))
    assert measured is not None
    assert measured.y_mm == 1.2
    assert measured.z_mm == pytest.approx(0.0, abs=1e-6)
    assert measured.covariance_mm2[0, 0] == pytest.approx(0.01, rel=1e-2)
    assert math.isnan(measured.gap_mm)
    assert measured.evidence_nats == 40.0
    assert fit_closed_joint(bench.section, joint, ImageLine(bench.section.y_mm[0], 0.1, 40.0)) is None


@settings(deadline=None, max_examples=25)
@given(seeds, st.booleans(), st.integers(1, 3))
def test_columns_and_their_whitening_are_numpy_s(seed: int, along_rows: bool, averaged: int) -> None:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 255, (60, 50)).astype(np.uint8)
    across = image.T if along_rows else image
    path = rng.uniform(-5.0, across.shape[1] + 5.0, len(across))
    columns, offsets = np.empty((8, len(across))), np.empty(8)
    average_columns(across, path, 6, averaged, columns, offsets)
    before = [-6 - averaged * k - np.arange(averaged) for k in range(4)]
    behind = [6 + averaged * k + np.arange(averaged) for k in range(4)]
    for j, pixels in enumerate([*before[::-1], *behind]):
        assert offsets[j] == pytest.approx(pixels.mean())
        places = np.rint(path).astype(int)[:, None] + pixels
        inside = ((places >= 0) & (places < across.shape[1])).all(axis=1)
        values = np.take_along_axis(across, np.clip(places, 0, across.shape[1] - 1), axis=1).mean(axis=1)
        np.testing.assert_allclose(columns[j], np.where(inside, values, np.nan))
    white = np.empty_like(columns)
    whiten(columns, 3, white)
    for column, read in zip(columns, white, strict=True):
        windows = np.lib.stride_tricks.sliding_window_view(column, 7)
        bare = np.full(len(column), np.nan)
        bare[3:-3] = column[3:-3] - np.median(windows, axis=1)
        if np.isfinite(bare).any():
            sigma = max(MAD_SIGMA * float(np.nanmedian(np.abs(bare))), CODE_SIGMA_DN)
            bare = np.clip(bare / sigma, -CLIP_SIGMAS, CLIP_SIGMAS)
        np.testing.assert_allclose(read, bare, atol=1e-12)


@settings(deadline=None, max_examples=25)
@given(seeds)
def test_sums_along_lines_are_numpy_s(seed: int) -> None:
    rng = np.random.default_rng(seed)
    white = rng.normal(size=(6, 40))
    white[rng.random(white.shape) < 0.1] = np.nan
    offsets, slopes = np.array([-9.0, -6.0, -3.0, 3.0, 6.0, 9.0]), rng.uniform(-1.5, 1.5, 4)
    along, counts = np.empty((2, len(slopes), white.shape[1]))
    sum_along(white, offsets, slopes, np.zeros(len(offsets)), along, counts)
    lines = np.arange(white.shape[1])
    for a, slope in enumerate(slopes):
        values = [
            np.interp(lines + slope * offset, lines, column, left=np.nan, right=np.nan)
            for offset, column in zip(offsets, white, strict=True)
        ]
        number = np.isfinite(values).sum(axis=0)
        np.testing.assert_array_equal(counts[a], number)
        np.testing.assert_allclose(along[a], np.nansum(values, axis=0) / np.sqrt(np.maximum(number, 1)))


@pytest.mark.parametrize("points", [0, 1, 19])
def test_a_profile_of_hardly_any_points_places_no_line(bench: Bench, points: int) -> None:
    image = plate(bench, np.random.default_rng(5)) + drawn(bench, 0.0, 0.0, 500.0, 20.0)
    middle = len(bench.section.y_mm) // 2
    few = bench.section.points[:, middle : middle + points]
    assert bench.read(image) is not None
    assert bench._replace(section=bench.section._replace(points=few)).read(image) is None


@pytest.mark.parametrize("lines", [0, 1, 19])
def test_a_stripe_of_hardly_any_sure_lines_places_no_line(bench: Bench, lines: int) -> None:
    image = plate(bench, np.random.default_rng(6)) + drawn(bench, 0.0, 0.0, 500.0, 20.0)
    path_px = np.full(len(bench.path_px), np.nan)
    path_px[:lines] = bench.path_px[:lines]
    assert bench._replace(path_px=path_px).read(image) is None


def test_a_wide_stripe_leaves_few_columns_beside_it(bench: Bench) -> None:
    """So many that there are fewer than pieces, and at last none."""
    image = plate(bench, np.random.default_rng(4)) + drawn(bench, 0.5, 1.0, math.inf, 40.0)
    read = [bench._replace(sigma_px=sigma_px).read(image) for sigma_px in np.arange(1.0, 60.0, 0.1)]
    assert read[0] is not None
    assert read[0].y_mm == pytest.approx(0.5, abs=0.1)
    assert read[-1] is None
