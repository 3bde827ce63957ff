"""Beads of drawn welds: what is measured of them lies within its sigma, and a plate shows none."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest

from noise_model.compiled.arrays import Float64
from tracker.bead import Bead, measure_beads

PLACES_MM = np.linspace(-15.0, 15.0, 480)
WHITE_MM, TEXTURE_MM, TEXTURE_LENGTH_MM = 0.01, 0.02, 2.0


class Weld(NamedTuple):
    """A drawn weld's heights, NaN in a twentieth of the places, and its true measures."""

    z_mm: Float64
    true: dict[str, float]


def texture(rng: np.random.Generator) -> Float64:
    """Return an autoregressive texture with white noise."""
    share = np.exp(-(PLACES_MM[1] - PLACES_MM[0]) / TEXTURE_LENGTH_MM)
    value, values = 0.0, []
    for step in rng.standard_normal(len(PLACES_MM)):
        value = share * value + np.sqrt(1.0 - share**2) * TEXTURE_MM * step
        values.append(value)
    return np.array(values) + WHITE_MM * rng.standard_normal(len(PLACES_MM))


def draw_weld(rng: np.random.Generator, is_fillet: bool) -> Weld:
    """Draw a parabola with a skew between two plates."""
    width, middle, height = rng.uniform(4.0, 10.0), rng.uniform(-1.0, 1.0), rng.uniform(0.4, 2.0)
    right, left = middle - 0.5 * width, middle + 0.5 * width
    slopes = np.array([-1.0, 1.0]) * is_fillet + rng.normal(0.0, 0.03, 2)
    step = 0.0 if is_fillet else rng.normal(0.0, 0.2)
    u = np.clip((PLACES_MM - right) / width, 0.0, 1.0)
    over = 4.0 * height * u * (1.0 - u) * (1.0 + rng.normal(0.0, 0.15) * (u - 0.5))
    outside = slopes[0] * np.minimum(PLACES_MM - right, 0.0) + slopes[1] * np.maximum(PLACES_MM - left, 0.0)
    z_mm = step * u + over + outside
    true = {
        "toe_right_mm": right,
        "toe_left_mm": left,
        "width_mm": np.hypot(width, step),
        "excess_mm": over.max() * width / np.hypot(width, step),
        "angle_deg": np.degrees(np.arctan(slopes) @ [-1.0, 1.0]),
    }
    if is_fillet:
        root_y = (slopes[0] * right - slopes[1] * left) / (slopes[0] - slopes[1])
        root_z = slopes[0] * (root_y - right)
        amid = (u > 0.0) & (u < 1.0)
        true["leg_right_mm"] = np.hypot(root_y - right, root_z)
        true["leg_left_mm"] = np.hypot(root_y - left, root_z)
        true["throat_mm"] = np.hypot(PLACES_MM[amid] - root_y, z_mm[amid] - root_z).min()
    else:
        true["misalignment_mm"] = step - (slopes @ [0.5, 0.5]) * width
    noisy = np.where(rng.random(len(PLACES_MM)) > 0.05, z_mm + texture(rng), np.nan)
    return Weld(noisy, true)


def measured(heights: list[Float64]) -> Iterator[Bead]:
    return measure_beads([(PLACES_MM, z_mm) for z_mm in heights])


@pytest.mark.slow
@pytest.mark.parametrize("is_fillet", [False, True])
def test_drawn_beads_lie_within_their_sigmas(is_fillet: bool) -> None:
    rng = np.random.default_rng(1)
    welds = [draw_weld(rng, is_fillet) for _ in range(8)]
    beads = list(measured([weld.z_mm for weld in welds]))
    assert not any(bead.problem for bead in beads)
    for name in welds[0].true:
        off = [
            (bead.measures[name].value - weld.true[name]) / bead.measures[name].sigma
            for bead, weld in zip(beads, welds, strict=True)
        ]
        assert np.sqrt(np.mean(np.square(off))) < 1.6, name
        limit = 0.4 if name.startswith(("toe", "width", "angle")) else 0.1
        assert np.median([bead.measures[name].sigma for bead in beads]) < limit, name


@pytest.mark.slow
def test_a_false_echo_moves_nothing() -> None:
    z_mm = draw_weld(np.random.default_rng(2), False).z_mm
    echoed = z_mm.copy()
    echoed[[40, 200, 231, 420]] += 4.0
    with_echo, without = (next(measured([heights])) for heights in (echoed, z_mm))
    for name, measure in without.measures.items():
        assert abs(with_echo.measures[name].value - measure.value) < 3.0 * measure.sigma + 0.01, name


@pytest.mark.slow
def test_an_undercut_is_measured() -> None:
    rng = np.random.default_rng(3)
    u = np.clip((PLACES_MM + 4.0) / 8.0, 0.0, 1.0)
    s = np.maximum(PLACES_MM + 4.0, 0.0) / 0.8
    face_mm = 4.0 * 0.8 * u * (1.0 - u) - 0.6 * s * np.exp(1.0 - s)
    for bead in measured([face_mm + texture(rng) for _ in range(3)]):
        for name, true in (("undercut_right_mm", -face_mm.min()), ("excess_mm", face_mm.max())):
            value, sigma = bead.measures[name]
            assert abs(value - true) < 3.0 * sigma, name
            assert sigma < 0.06, name
        assert bead.measures["undercut_left_mm"].value < 0.03


@pytest.mark.slow
def test_a_plate_shows_no_bead() -> None:
    rng = np.random.default_rng(4)
    assert [bead.problem for bead in measured([texture(rng) for _ in range(4)])] == ["no_bead"] * 4


def test_a_profile_of_few_points_is_not_measured() -> None:
    z_mm = np.where(np.arange(len(PLACES_MM)) < 30, 0.0, np.nan)
    assert [bead.problem for bead in measured([z_mm])] == ["too_few_points"]
