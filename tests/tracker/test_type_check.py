"""The stated type against profiles of every type, and the cut into pieces against one by hand."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import COLUMN_MM, Profile, measure, spoil
from test_joint_types import CASES, LINE, fit, seen

from noise_model.surface.joint import Joint
from tracker.joint.measured import MeasuredJoint
from tracker.joint.type_check import (
    GROUPS,
    JointFamily,
    cut_into_pieces,
    family_of,
    shown_family,
    shows_another,
)
from tracker.state import Y_MM, Z_MM

EACH = 12
SEAM = 0.3, 0.1
PLATE = np.array([(-60.0, 0.0), (60.0, 0.0)])
SHOWN = {name: family_of(joint) for name, (joint, _) in CASES.items() if name != "edge"}


def is_another_type(profile: Profile, joint: Joint, measured: MeasuredJoint | None) -> bool:
    """Whether a profile shows another type than a stated joint, by that one's fit."""
    return shows_another(profile.seen_from(), joint, measured)


def cost_of(y, z, sigma, penalty, borders) -> float:
    """What pieces between borders cost, each line by NumPy's own least squares."""
    total = 0.0
    for first, last in itertools.pairwise([0, *borders, len(y)]):
        part = slice(first, last)
        if last - first > 2:
            line = np.polynomial.Polynomial.fit(y[part], z[part], 1, w=1.0 / sigma[part])
            total += float(np.sum(((z[part] - line(y[part])) / sigma[part]) ** 2))
    return total + penalty * len(borders)


@pytest.mark.slow
@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_no_other_cut_into_pieces_is_cheaper(seed: int) -> None:
    rng = np.random.default_rng(seed)
    y = np.cumsum(rng.uniform(0.5, 1.5, 9))
    z = np.where(y > y[4], rng.normal(0.0, 2.0), 0.0) + rng.normal(0.0, 0.3) * y + rng.normal(0.0, 0.1, 9)
    sigma = rng.uniform(0.05, 0.2, 9)
    ends = np.empty(9, dtype=np.int64)
    cost, n = cut_into_pieces(y, z, sigma, 6.0, ends)
    borders = [list(chosen) for size in range(9) for chosen in itertools.combinations(range(1, 9), size)]
    cheapest = min(cost_of(y, z, sigma, 6.0, chosen) for chosen in borders)
    assert cost - 6.0 == pytest.approx(cheapest, abs=1e-6)
    assert cost_of(y, z, sigma, 6.0, list(ends[: n - 1])) == pytest.approx(cheapest, abs=1e-6)
    assert ends[n - 1] == 9


@pytest.mark.parametrize("name", [*SHOWN, "plate"])
def test_a_section_shows_its_own_family(name: str) -> None:
    rng = np.random.default_rng(16)
    for _ in range(EACH):
        profile = measure(PLATE, SEAM, rng) if name == "plate" else seen(CASES[name][1](rng), SEAM, rng)
        assert shown_family(profile.points) is (JointFamily.FLAT if name == "plate" else SHOWN[name])


@pytest.mark.parametrize("wrong", [0.0, 0.1])
@pytest.mark.parametrize("name", CASES)
def test_the_own_type_is_never_doubted(name: str, wrong: float) -> None:
    joint, draw = CASES[name]
    rng = np.random.default_rng(11)
    for _ in range(4 * EACH):
        seam = (rng.uniform(-3.0, 3.0), rng.uniform(-1.0, 1.0))
        profile = spoil(seen(draw(rng), seam, rng), wrong, rng)
        assert not is_another_type(profile, joint, fit(profile, joint, seam))


@pytest.mark.parametrize("slope", [-0.5, 0.5])
def test_a_short_slope_at_an_end_is_no_plate(slope: float) -> None:
    """A streak that crosses the stripe at the image's rim, three groups wide, makes no corner of a groove."""
    joint, draw = CASES["v_groove"]
    rng = np.random.default_rng(15)
    for _ in range(EACH):
        profile = seen(draw(rng), SEAM, rng)
        points = profile.points
        width = 3 * -(-points.shape[1] // GROUPS)
        end_mm = points[Y_MM, width]
        points[Z_MM, :width] += slope * (points[Y_MM, :width] - end_mm)
        assert shown_family(points) is not JointFamily.OUTSIDE_CORNER
        assert not is_another_type(profile, joint, fit(profile, joint, SEAM))


@pytest.mark.parametrize(("stated", "shown"), list(itertools.product(SHOWN, SHOWN)))
def test_another_family_is_told_and_the_same_is_not(stated: str, shown: str) -> None:
    joint, draw = CASES[stated][0], CASES[shown][1]
    rng = np.random.default_rng(12)
    told = 0
    for _ in range(EACH):
        seam = (rng.uniform(-3.0, 3.0), rng.uniform(-1.0, 1.0))
        profile = seen(draw(rng), seam, rng)
        told += is_another_type(profile, joint, fit(profile, joint, seam))
    assert told == (0 if SHOWN[stated] is SHOWN[shown] else EACH)


@pytest.mark.parametrize("name", SHOWN)
def test_a_plate_is_no_joint(name: str) -> None:
    joint, _ = CASES[name]
    rng = np.random.default_rng(13)
    for _ in range(EACH):
        profile = measure(PLATE, (0.0, 0.0), rng)
        found = fit(profile, joint, (0.0, 0.0))
        assert found is None or found.chi2 > 9.0
        assert is_another_type(profile, joint, found)


def test_a_gap_that_nothing_is_seen_of_is_a_plate_that_a_butts_edges_still_show() -> None:
    """Where the laser does not reach the gap's bottom, no point lies below the plates."""
    joint, draw = CASES["butt"]
    rng = np.random.default_rng(14)
    for _ in range(EACH):
        truth = draw(rng)
        profile = seen(truth, (0.5, 0.0), rng)
        keep = profile.z_mm > -1.5
        dark = type(profile)(
            *(getattr(profile, f)[keep] for f in ("y_mm", "z_mm", "dy_mm", "dz_mm", "sigma_px", "scan")),
            profile.column_mm,
            profile.beside_px[keep],
        )
        found = fit(dark, joint, (0.5, 0.0))
        assert found is not None
        assert math.hypot(found.y_mm - 0.5, found.z_mm) < 5.0 * math.sqrt(np.trace(found.covariance_mm2))
        assert not is_another_type(dark, joint, found)


@pytest.mark.parametrize("gap_mm", [0.0, 3.0 * COLUMN_MM])
def test_a_plate_may_be_a_butt_whose_gap_is_too_narrow_to_show(gap_mm: float) -> None:
    joint = Joint("butt", {"gap_mm": gap_mm, "thickness_mm": 3.0}, LINE)
    profile = measure(PLATE, (0.0, 0.0), np.random.default_rng(15))
    found = fit(profile, joint, (0.0, 0.0))
    assert found is None
    assert not is_another_type(profile, joint, found)


def test_families_by_their_names() -> None:
    assert SHOWN["fillet"] is SHOWN["wide fillet"] is JointFamily.INSIDE_CORNER
    assert SHOWN["ridge"] is JointFamily.OUTSIDE_CORNER
    assert SHOWN["v_groove"] is SHOWN["half_v"] is SHOWN["u_groove"] is JointFamily.GROOVE
    assert family_of(CASES["edge"][0]) is None
