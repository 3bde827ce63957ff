"""The scan lines about a gap between two plates, on bands of light that are drawn with known ends."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import SATURATION_DN, Profile
from stripe_ends import EDGE, N_SCAN, light_of, profile_of

from tracker.joint.measured import OnFace
from tracker.joint.plate_lines import (
    HIDDEN,
    UNREAD,
    OnPlates,
    PlateLines,
    best_place,
    end_between,
    end_by_shares,
    excess_e,
    is_outshone,
    lines_read,
    plate_lines,
    vote,
)
from tracker.profile import Section
from tracker.state import N_LINES, SCAN
from tracker.stripe.light import NO_LIGHT

NOWHERE = np.full(3, math.nan)
FULL_E = 20000.0


def lines_about_a_gap(seed: int) -> tuple[Section, Profile, OnPlates, bool]:
    """Lines of two plates with a gap between them, of any width, some lost, dim, under a glint or flipped."""
    rng = np.random.default_rng(seed)
    gap, flipped, beyond = int(rng.integers(0, 12)), bool(rng.integers(2)), bool(rng.integers(2))
    first, last = EDGE - gap // 2, EDGE - gap // 2 + gap
    light = light_of(
        rng,
        first + rng.uniform(-1.0, 1.0),
        last + rng.uniform(-1.0, 1.0),
        apart_px=rng.choice([0.0, 5.0]),
        contrast=0.1,
        flipped=flipped,
    )
    image_dn = np.rint(np.clip(light.charge_e, 0.0, 60000.0)).astype(np.uint16)
    if rng.random() < 0.3:
        image_dn[EDGE - 1 : EDGE + 2, 20:60] = SATURATION_DN
    image_dn[rng.random(N_SCAN) < 0.05] = 500
    if rng.integers(2):
        image_dn = np.ascontiguousarray(image_dn.T).T
    scan = np.arange(N_SCAN)
    in_gap = (scan >= first) & (scan < last)
    kept = rng.random(N_SCAN) > np.where(in_gap, 0.5, 0.03)
    are_on = ~(in_gap & (rng.random(N_SCAN) < 0.9))
    order = np.arange(N_SCAN)[kept]
    profile = profile_of(light)
    lost = replace(
        profile,
        image_dn=image_dn if rng.random() < 0.9 else None,
        light=light if rng.random() < 0.9 else NO_LIGHT,
        **{
            name: getattr(profile, name)[order]
            for name in ("y_mm", "z_mm", "dy_mm", "dz_mm", "sigma_px", "beside_px")
        },
        scan=(scan[::-1] if flipped else scan)[order].astype(float),
    )
    face = OnFace(lost.y_mm + 0.01 * rng.uniform(size=len(order)), rng.uniform(size=len(order)))
    return lost.seen_from(NOWHERE, NOWHERE), lost, OnPlates(are_on[kept], face), beyond


def a_clean_gap(seed: int, lines_apart: int) -> tuple[PlateLines, Section, tuple[float, float], Profile]:
    """Two plates' lines that end `lines_apart` from each other, and the y at which they do, mm."""
    rng = np.random.default_rng(seed)
    ends = EDGE - 0.5 * lines_apart + rng.uniform(-0.5, 0.5, 2) + np.array([0.0, lines_apart])
    light = light_of(rng, *ends, apart_px=0.0)
    image_dn = np.rint(np.clip(light.charge_e, 0.0, 60000.0)).astype(np.uint16)
    scan = np.arange(N_SCAN, dtype=float)
    is_read = (scan < ends[0] - 1.0) | (scan > ends[1] + 1.0)
    names = ("y_mm", "z_mm", "dy_mm", "dz_mm", "sigma_px", "beside_px", "scan")
    profile = profile_of(light)
    profile = replace(
        profile, image_dn=image_dn, light=light, **{name: getattr(profile, name)[is_read] for name in names}
    )
    n = int(is_read.sum())
    section = profile.seen_from(NOWHERE, NOWHERE)
    on_plates = OnPlates(np.ones(n, dtype=bool), OnFace(profile.y_mm, np.zeros(n)))
    lines = plate_lines(section, on_plates, False, profile.image)
    return lines, section, (0.1 * (ends[0] - EDGE), 0.1 * (ends[1] - EDGE)), profile


def test_a_gaps_ends_are_where_its_plates_end() -> None:
    for seed in range(40):
        lines, section, (first_mm, last_mm), _ = a_clean_gap(seed, 12)
        for is_first, true_mm in ((True, first_mm), (False, last_mm)):
            low_mm, high_mm = (-2.5, 0.0) if is_first else (0.0, 2.5)
            end = end_between(lines, section.light, low_mm, high_mm, is_first)
            assert end.y_mm == pytest.approx(true_mm, abs=0.3)
            # The lines are 0.1 mm apart: their light tells a tenth of that.
            refined = end_by_shares(lines, section.light, end, is_first, 12)
            assert refined.y_mm == pytest.approx(true_mm, abs=0.01)


def test_plates_are_placed_about_their_gap() -> None:
    for seed in range(40):
        lines, _, at_mm, _ = a_clean_gap(seed, 12)
        assert best_place(lines, 1.0, at_mm[1] - at_mm[0], False) == pytest.approx(np.mean(at_mm), abs=0.2)


@pytest.mark.parametrize("lines_apart", [0, 12])
def test_lines_of_a_stripe_that_goes_on_hold_the_plates(lines_apart: int) -> None:
    for seed in range(20):
        lines, _, _, _ = a_clean_gap(seed, lines_apart)
        # Where a plate ends amid a line, that may be either.
        in_gap = lines.sees[EDGE - 3 : EDGE + 4]
        assert np.isin(in_gap, (1.0, HIDDEN) if lines_apart == 0 else (UNREAD,)).all(), seed


STREAK = slice(EDGE + 4, EDGE + 10)
"""Lines of the plate behind a gap of 12 lines, with the gap's last one or two."""


def under_a_streak(seed: int, streak_dn: int) -> tuple[PlateLines, Section, tuple[float, float]]:
    """A gap's lines with a streak's even light over those about its end, of which none was read."""
    _, _, at_mm, profile = a_clean_gap(seed, 12)
    assert profile.image_dn is not None
    image_dn = profile.image_dn.astype(int)
    image_dn[STREAK] = np.minimum(image_dn[STREAK] + streak_dn, SATURATION_DN)
    section, on_plates, profile = unread_over(STREAK, replace(profile, image_dn=image_dn.astype(np.uint16)))
    return plate_lines(section, on_plates, False, profile.image), section, at_mm


def unread_over(lines: slice, profile: Profile) -> tuple[Section, OnPlates, Profile]:
    """A profile of plates without what was read in some lines."""
    kept = (profile.scan < lines.start) | (profile.scan >= lines.stop)
    names = ("y_mm", "z_mm", "dy_mm", "dz_mm", "sigma_px", "beside_px", "scan")
    profile = replace(profile, **{name: getattr(profile, name)[kept] for name in names})
    face = OnFace(profile.y_mm, np.zeros(len(profile.y_mm)))
    on_plates = OnPlates(np.ones(len(profile.y_mm), dtype=bool), face)
    return profile.seen_from(NOWHERE, NOWHERE), on_plates, profile


def test_a_plate_under_a_streak_holds_its_light_and_its_gap_ends_there() -> None:
    for seed in range(20):
        lines, section, (_, last_mm) = under_a_streak(seed, 8000)
        assert (lines.sees[EDGE + 8 : STREAK.stop] == 1.0).all()
        end = end_between(lines, section.light, 0.0, 2.5, False)
        assert end.y_mm == pytest.approx(last_mm, abs=0.3)


def test_what_a_saturated_streak_covers_widens_the_end_beneath_it() -> None:
    for seed in range(20):
        lines, section, (_, last_mm) = under_a_streak(seed, SATURATION_DN)
        assert (lines.sees[STREAK] == HIDDEN).all()
        end = end_between(lines, section.light, 0.0, 2.5, False)
        assert end.variance_mm2 >= 0.5**2 / 12.0
        assert abs(end.y_mm - last_mm) < 2.0 * math.sqrt(end.variance_mm2)


@pytest.mark.parametrize("off_px", [9.0, 12.0])
def test_glints_on_either_side_of_a_stripe_hide_where_its_plate_ends(off_px: float) -> None:
    """Between them the light is no slope: a stripe over it would seem to be missing."""
    for seed in range(10):
        _, _, (_, last_mm), profile = a_clean_gap(seed, 12)
        s, px = np.indices(profile.light.charge_e.shape)
        begins = EDGE + 10.0 * last_mm
        for side_px in (-off_px, off_px):
            r_2 = (s - begins - 3.0) ** 2 + (px - 40.3 - side_px) ** 2
            profile.light.charge_e[:] += 2e5 * np.exp(-0.5 * r_2 / 2.0**2)
        np.minimum(profile.light.charge_e, FULL_E, out=profile.light.charge_e)
        profile.light.censored[:] = profile.light.charge_e == FULL_E
        image_dn = np.where(profile.light.censored, SATURATION_DN, profile.light.charge_e).astype(np.uint16)
        hidden = slice(math.floor(begins), math.floor(begins) + 8)
        profile.light.position_px[hidden] = math.nan
        section, on_plates, profile = unread_over(hidden, replace(profile, image_dn=image_dn))
        lines = plate_lines(section, on_plates, False, profile.image)
        end = end_between(lines, section.light, 0.0, 2.5, False)
        assert abs(end.y_mm - last_mm) < 2.0 * math.sqrt(end.variance_mm2)
        assert math.isnan(end_by_shares(lines, section.light, end, False, 12).y_mm)


def test_lines_beyond_the_image_hold_no_light() -> None:
    """An edge joint's are asked there, too."""
    light = light_of(np.random.default_rng(1), EDGE, EDGE + 14)
    light.censored[:] = True
    assert is_outshone(light, EDGE, 40.0, 5.0, 1.0)
    assert excess_e(light, EDGE - 5, 40.0) > 0.0
    for scan in (-20, -1, N_SCAN, N_SCAN + 20):
        assert not is_outshone(light, scan, 40.0, 5.0, 1.0)
        assert math.isnan(excess_e(light, scan, 40.0))


@pytest.mark.parametrize(
    ("read", "share", "off", "says"),
    [
        (1.0, 0.9, 0.2, 1.0),
        (1.0, 0.9, 0.8, HIDDEN),
        (1.0, 0.1, 0.05, UNREAD),
        (1.0, 5.0, 0.1, HIDDEN),
        (1.0, math.nan, math.nan, HIDDEN),
        (UNREAD, 0.1, 0.1, UNREAD),
        (UNREAD, 0.1, 0.6, HIDDEN),
        (UNREAD, 0.9, 0.1, 1.0),
        (-1.0, 0.1, 0.2, -1.0),
        (-1.0, 0.1, 0.6, HIDDEN),
        (-1.0, 0.9, 0.1, HIDDEN),
    ],
)
def test_a_line_votes_by_the_light_that_it_holds(read: float, share: float, off: float, says: float) -> None:
    assert vote(read, share, off, 3.0) == says


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_two_lines_that_were_read_as_one_both_see_what_it_sees(seed: int) -> None:
    section, _, on_plates, beyond = lines_about_a_gap(seed)
    points, rng = section.points, np.random.default_rng(seed)
    row_of = {int(s): row for row, s in enumerate(section.scan)}
    first_of_two = {
        s
        for s in row_of
        if s % 2 == 0
        and s + 1 in row_of
        and on_plates.are_on[row_of[s]] == on_plates.are_on[row_of[s + 1]]
        and rng.random() < 0.6
    }
    kept = np.array([row for s, row in row_of.items() if s - s % 2 not in first_of_two or s % 2 == 0])
    n_lines = np.array([2.0 if int(s) in first_of_two else 1.0 for s in section.scan[kept]])
    fewer = np.take(points, kept, axis=1)
    fewer[SCAN] += 0.5 * (n_lines - 1.0)
    fewer[N_LINES] = n_lines
    face = OnFace(*(values[kept] for values in on_plates.face))
    seen = lines_read(section._replace(points=fewer), OnPlates(on_plates.are_on[kept], face), beyond)
    alone = lines_read(section, on_plates, beyond)
    np.testing.assert_array_equal(seen.sees, alone.sees)
    assert (seen.away, seen.first_scan) == (alone.away, alone.first_scan)


def test_the_drawn_lines_are_of_all_kinds() -> None:
    seen = []
    for seed in range(40):
        section, profile, on_plates, beyond = lines_about_a_gap(seed)
        seen.append(plate_lines(section, on_plates, beyond, profile.image).sees)
    for value in (1.0, -1.0, UNREAD, HIDDEN):
        assert sum((sees == value).any() for sees in seen) > 4, value
