"""The scan lines about a gap between two plates, against NumPy twins on bands of drawn light."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import Profile
from slot_twins import LinesTwin
from stripe_ends import EDGE, N_SCAN, light_of, profile_of

from noise_model.compiled.arrays import Float64
from tracker.joint.evidence import gap_evidence_nats
from tracker.joint.measured import OnFace
from tracker.joint.plate_lines import (
    HIDDEN,
    UNREAD,
    OnPlates,
    PlateLines,
    best_place,
    blurred_lines,
    end_between,
    end_by_shares,
    evidence_of_gap,
    hold_plates,
    interpolated,
    lines_read,
    others_between,
    plate_lines,
)
from tracker.profile import Section
from tracker.state import N_LINES, SCAN
from tracker.stripe.light import NO_LIGHT

NOWHERE = np.full(3, math.nan)


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
    if rng.random() < 0.3:
        light.censored[EDGE - 1 : EDGE + 2, 20:60] = True
    image_dn = np.rint(np.clip(light.charge_e, 0.0, 60000.0)).astype(np.uint16)
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


def both(seed: int) -> tuple[PlateLines, LinesTwin, Section, Profile]:
    section, profile, on_plates, beyond = lines_about_a_gap(seed)
    lines = plate_lines(section, on_plates, beyond, *profile.given)
    return lines, LinesTwin(profile, on_plates, beyond), section, profile


@settings(deadline=None, max_examples=80)
@given(st.integers(0, 2**32 - 1))
def test_lines_see_what_their_twins_see(seed: int) -> None:
    lines, twin, section, _ = both(seed)
    np.testing.assert_array_equal(lines.sees, twin.sees)
    np.testing.assert_allclose(lines.y_mm, twin.y_mm, atol=1e-12)
    for y_mm in (-2.0, 0.03, 1.7):
        y_per_z = interpolated(y_mm, lines.y_mm, lines.y_per_z)
        assert y_per_z == pytest.approx(twin.y_per_z_at(y_mm), abs=1e-9)
    assert (lines.away, lines.first_scan) == (twin.away, twin.first_scan)
    assert blurred_lines(section.light) == twin.blurred
    for first, last in ((3, 40), (EDGE, EDGE + 1), (20, 50)):
        assert others_between(lines, first, last) == twin.others_between(first, last)


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


@settings(deadline=None, max_examples=80)
@given(st.integers(0, 2**32 - 1), st.floats(0.5, 2.5), st.floats(0.0, 1.2), st.booleans())
def test_plates_are_placed_as_their_twin_is(seed: int, plate_mm: float, gap_mm: float, ends: bool) -> None:
    lines, twin, _, _ = both(seed)
    placed, twins = best_place(lines, plate_mm, gap_mm, ends), twin.place(plate_mm, gap_mm, ends)
    assert placed == pytest.approx(math.nan if twins is None else twins, abs=1e-12, nan_ok=True)


@settings(deadline=None, max_examples=80)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.floats(-0.5, 0.5))
def test_ends_are_their_twins(seed: int, plate_first: bool, y_mm: float) -> None:
    lines, twin, section, _ = both(seed)
    low_mm, high_mm = (y_mm - 1.5, y_mm) if plate_first else (y_mm, y_mm + 1.5)
    end = end_between(lines, section.light, low_mm, high_mm, plate_first)
    end_twin = twin.end(low_mm, high_mm, plate_first)
    assert end == pytest.approx(end_twin, abs=1e-12)
    told, told_twin = end_by_shares(lines, section.light, end, plate_first, 5), None
    if 0 < end.line < len(lines.sees) - 1:
        told_twin = twin.by_shares(end_twin, plate_first, 5)
        assert math.isnan(told.y_mm) == (told_twin is None)
    if told_twin is not None:
        assert told == pytest.approx(told_twin, abs=1e-9)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_lines_hold_plates_and_lack_them_as_their_twins_do(seed: int) -> None:
    section, profile, on_plates, _ = lines_about_a_gap(seed)
    image_dn, along_rows = profile.given
    lines = plate_lines(section, on_plates, False, image_dn, along_rows)
    twin = LinesTwin(profile, on_plates, False)
    for first, last in ((EDGE - 3, EDGE + 3), (EDGE - 1, EDGE), (10, 14)):
        holds = hold_plates(lines, section.light, image_dn, along_rows, first, last)
        assert holds == twin.hold_plates(first, last)
        is_lost, shown = lines.sees < 0.0, np.flatnonzero(lines.sees > 0.0)
        kept = slice(shown[0], shown[-1] + 1)
        nats = gap_evidence_nats(is_lost[kept], first - int(shown[0]), last - int(shown[0]), 40.0)
        assert evidence_of_gap(lines, first, last, 40.0) == nats


def test_the_drawn_lines_are_of_all_kinds() -> None:
    drawn = [both(seed) for seed in range(40)]
    seen: list[Float64] = [lines.sees for lines, _, _, _ in drawn]
    for value in (1.0, -1.0, UNREAD, HIDDEN):
        assert sum((sees == value).any() for sees in seen) > 4, value
