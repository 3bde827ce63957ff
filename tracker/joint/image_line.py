"""The seam's line in the image: it shows a closed joint off the stripe, where the profile shows nothing.

Two plates that touch leave no gap in a stripe. Their seam is a line all the same: a dark slit, a bright rim,
both next to each other, or the border of two plates that shine unlike. It crosses the stripe. It is sought
off the stripe, on both sides of it and as far as `ALONG_MM` along the seam, on lines of every place and of
all directions about the seam's, which turn as the nominal line does.

Of each column off the stripe the running median along the stripe is taken off, which takes the slow
changes of brightness. What is left is divided by the column's robust scatter and summed along each
line. Two filters read the sum: an even one for a slit or a rim, an odd one for both. They are a bell times
the Hermite polynomials of the fourth and third order, which see neither slope nor bow of the brightness, as
the arc's reflection has. The sum of their squares over their variances, both of all the places that are
looked at, is a chi^2 with two degrees of freedom where there is no line: it exceeds Q anywhere among N
places with the probability N exp(-Q / 2) at most. Scratches and grain of the plate are lines too. So the
strongest of what lies elsewhere tells how far a plate like this exceeds chance: the scatter is widened until
it is what is expected of N places. A line that is not decidedly stronger than all others is not the seam's.

The line's course is then read in pieces along it, each by its shift against the line's mean section, whose
Cramer-Rao bound is its sigma, and a parabola is laid through them: a seam may be curved. Where the parabola
meets the stripe is the seam, to within the line's own width.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from noise_model.arc.scene import Scene
from noise_model.compiled.arrays import Bool, Float64, Int64, Integers
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import exact_median
from noise_model.instrument.laser import plane_met, sheet_in
from noise_model.robust import MAD_SIGMA
from noise_model.transforms import invert, transform
from tracker.geometry import SensorGeometry
from tracker.joint.evidence import fit_plate
from tracker.joint.section_fit import BISQUARE_WIDTH
from tracker.profile import MIN_POINTS, Section, in_scan_order
from tracker.state import SCAN, Y_MM

ALONG_MM = 12.0
"""Reach along the seam on either side of the stripe over which its line is read."""

COURSE_MM = np.linspace(-1.5 * ALONG_MM, 1.5 * ALONG_MM, 73)
"""Distances along the nominal line at which its course is projected."""

CLEAR_SIGMAS = 6.0
"""Half-width of the stripe's own light, in its sigmas."""

CLIP_SIGMAS = 4.0
"""A pixel counts as no farther off: glints and spatter are bright."""

MAX_RIVAL = 0.6
"""The next strongest line's share of the strongest, in sigmas, at which neither is taken for the seam's.

On a plain plate it is above 0.8 in all frames that were looked at, next to a closed butt below 0.45.
"""

N_PIECES, MIN_PIECES = 12, 5
"""Pieces in which a line's course is read, and that must show it."""

MIN_RADIUS_MM = 100.0
"""1 sigma of a seam's curvature off its nominal line's is that of a circle so large."""

DARK_SHARES = 0.2, 0.6
"""Darkness over the rim's brightness. Below the first share it is the plate's texture, by more
than the second it is the slit; between them it may be either."""

CODE_SIGMA_DN = 12.0**-0.5
"""No column scatters by less than the rounding of its codes."""

MIN_SIGMA = 1e-6
"""The sums scatter by more, but for an image that is the same everywhere."""


@dataclass(frozen=True)
class ImageLine:
    """Intersection of the seam's line with the stripe: y, joint frame, and 1 sigma, mm; evidence, nats."""

    y_mm: float
    sigma_mm: float
    evidence_nats: float


@dataclass(frozen=True)
class _Course:
    """Expected course of a seam across the stripe: its reach, px, and the first and last of its slopes.

    Slopes are scan lines a pixel of distance. At `offsets_px` (n,) the nominal line leaves its tangent by
    `bends` (n,) scan lines.
    """

    reach_px: float
    first: float
    last: float
    offsets_px: Float64
    bends: Float64


@dataclass(frozen=True)
class _Sums:
    """The whitened columns (m, n_scan) at `offsets_px` (m,) from the stripe, summed along the seam's course.

    `read` are these columns, or their dark pixels alone.
    `along` (k, n_scan) are the sums over lines that meet the stripe in each scan line with the slopes (k,),
    scan lines a pixel, and leave that direction by `bends` (m,), over the root of how many columns they are
    of. `energy` (k, n_scan) is the two filters' chi^2, 0 where too few columns tell it; the filters' 1 sigma
    is `width` scan lines, each `column_mm` wide.
    """

    white: Float64
    read: Float64
    offsets_px: Float64
    slopes: Float64
    bends: Float64
    along: Float64
    energy: Float64
    width: float
    column_mm: float


def read_image_line(
    geometry: SensorGeometry,
    scene: Scene,
    path_px: Float64,
    stripe_sigma_px: float,
    section: Section,
    image_dn: Integers,
    arc_burns: bool,
) -> ImageLine | None:
    """Return the line that a seam leaves in the image off its stripe; None where nothing can be read.

    `scene` is the look's, its x axis along the expected seam; `path_px` (n_scan,) the stripe's centre, NaN
    where it was not read, `stripe_sigma_px` its 1 sigma across. `section` gives each scan line its y, and the
    reach about 0; `image_dn` (n_scan, n_pos) is the frame by scan line. While an arc burns a line is dark.
    """
    # Of a weak stripe no line's smooth centre may be sure enough to be one.
    if min(len(section.y_mm), np.isfinite(path_px).sum()) < MIN_POINTS:
        return None
    path = _plates_path(path_px)
    expected = _expected_course(geometry, scene, path)
    if expected is None:
        return None
    reach_px = expected.reach_px
    guard_px = math.ceil(CLEAR_SIGMAS * stripe_sigma_px)
    # Columns that are read on either side: more are averaged into so many.
    averaged = max(1, math.ceil((reach_px - guard_px) / 40))
    n_each = int((reach_px - guard_px) / averaged)
    if n_each < MIN_PIECES:
        return None
    gap_lines = geometry.setup.joint.dimensions["gap_mm"] / section.column_mm
    # 1 sigma of the narrowest line that is sought, scan lines: a slit that is blurred by lens and pixel.
    width = max(1.5, 0.5 * gap_lines)
    columns, offsets_px = np.empty((2 * n_each, len(path))), np.empty(2 * n_each)
    average_columns(image_dn, path, guard_px, averaged, columns, offsets_px)
    white = np.empty_like(columns)
    # Half the running median's length, over the line's 1 sigma.
    whiten(columns, math.ceil(5.0 * width), white)
    n_slopes = 2 + math.ceil(abs(expected.last - expected.first) * reach_px / width)
    slopes = np.linspace(expected.first, expected.last, n_slopes)
    bends = np.interp(offsets_px, expected.offsets_px, expected.bends, left=np.nan, right=np.nan)
    white[np.isnan(bends)] = np.nan
    bends = np.nan_to_num(bends)
    # Spatter's streaks point away from the arc as the seam does, and only add light.
    read = np.minimum(white, 0.0) if arc_burns else white
    along, counts = np.empty((2, n_slopes, len(path)))
    sum_along(read, offsets_px, slopes, bends, along, counts)
    # A line that leaves the image within more of its columns is not summed.
    energy = _energy(along, counts >= 0.5 * len(offsets_px), width, arc_burns)
    return _place(
        section,
        _Sums(
            white=white,
            read=read,
            offsets_px=offsets_px,
            slopes=slopes,
            bends=bends,
            along=along,
            energy=energy,
            width=width,
            column_mm=section.column_mm,
        ),
    )


def _plates_path(path_px: Float64) -> Float64:
    """Return a stripe's smooth course (n_scan,) on its plates, px, over lines that are off them too."""
    is_read = np.flatnonzero(np.isfinite(path_px))
    read_px, off_px = path_px[is_read], np.empty(len(is_read))
    still, a_pixel = np.zeros(len(is_read)), np.ones(len(is_read))
    fit_plate(is_read.astype(np.float64), read_px, still, a_pixel, a_pixel, a_pixel, off_px)
    return np.interp(np.arange(len(path_px)), is_read, read_px - off_px)


def _expected_course(geometry: SensorGeometry, scene: Scene, path_px: Float64) -> _Course | None:
    """Return how a seam is expected to cross a stripe (n_scan,), px; None where it is not seen to."""
    sheet = sheet_in(scene.T_joint_tool, geometry.stripe_source.sheet)
    nx, _, _, d = plane_met(sheet, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    # The line's direction may be off the expected seam's by so much.
    turn = math.radians(10.0) * np.array([-1.0, -1.0, 1.0, 1.0])
    along = ALONG_MM * np.array([-1.0, 1.0, -1.0, 1.0])
    ends = np.column_stack([along * np.cos(turn), along * np.sin(turn), np.zeros(4)])
    nominal = geometry.seam_source.line.course(-d / nx, COURSE_MM)[:, :3]
    camera, points = geometry.setup.camera, np.vstack([ends, nominal]) - (d / nx, 0.0, 0.0)
    seen = geometry.scan_points(camera.project(transform(invert(scene.T_joint_camera), points)))
    lean = float(np.polyfit(np.arange(len(path_px)), path_px, 1)[0])
    across, spacing = (seen[1:4:2] - seen[:4:2]).T
    # In pixels from the stripe itself, which may lie skewed to the scan lines.
    spacing = spacing - lean * across
    if not (np.abs(spacing) > MIN_PIECES).all() or spacing[0] * spacing[1] < 0.0:
        return None
    first, last = (across / spacing).tolist()
    middle = len(COURSE_MM) // 2
    across, off_px = (seen[4:] - seen[4 + middle]).T
    off_px = math.copysign(1.0, spacing[0]) * (off_px - lean * across)
    # A line that turns back along the stripe is followed up to there.
    low = middle - int(np.argmin(np.append(np.diff(off_px[middle::-1]) < 0.0, False)))
    high = middle + int(np.argmin(np.append(np.diff(off_px[middle:]) > 0.0, False)))
    if not low < middle < high:
        return None
    slope = (across[middle + 1] - across[middle - 1]) / (off_px[middle + 1] - off_px[middle - 1])
    followed = slice(low, high + 1)
    bends = across[followed] - slope * off_px[followed]
    off_px = math.copysign(1.0, spacing[0]) * off_px[followed]
    order = np.argsort(off_px)
    return _Course(0.5 * float(np.abs(spacing).min()), first, last, off_px[order], bends[order])


@kernel(allocates=True)
def average_columns(
    image_dn: Integers, path_px: Float64, guard_px: int, averaged: int, columns: Float64, offsets_px: Float64
) -> None:
    """Write the light (2 m, n_scan) off a stripe's path (n_scan,), DN, and its distance from it (2 m,), px.

    `image_dn` (n_scan, n_pos) is the frame by scan line. The first m columns lie before the stripe, the
    others behind it, each the mean of so many pixels. NaN outside the image.
    """
    each, n_pos = columns.shape[0] // 2, image_dn.shape[1]
    for j in range(2 * each):
        first = guard_px + (j - each) * averaged if j >= each else -guard_px - (each - j) * averaged + 1
        offsets_px[j] = first + 0.5 * (averaged - 1)
        for s in range(path_px.shape[0]):
            low = round(path_px[s]) + first
            if low < 0 or low + averaged > n_pos:
                columns[j, s] = math.nan
                continue
            total = 0.0
            for v in range(low, low + averaged):
                total += image_dn[s, v]
            columns[j, s] = total / averaged


@kernel(allocates=True)
def whiten(columns: Float64, half: int, white: Float64) -> None:
    """Write columns (m, n) less their running medians over 2 `half` + 1 lines, in their robust sigmas.

    No pixel counts as farther off than CLIP_SIGMAS. NaN where the column is, or the median's window leaves
    it.
    """
    n = columns.shape[1]
    sizes = np.empty(n)
    for j in range(columns.shape[0]):
        count = 0
        for s in range(n):
            white[j, s] = math.nan
            if half <= s < n - half:
                white[j, s] = columns[j, s] - exact_median(columns[j, s - half : s + half + 1])
            if not math.isnan(white[j, s]):
                sizes[count] = abs(white[j, s])
                count += 1
        if count == 0:
            continue
        sigma = max(MAD_SIGMA * exact_median(sizes[:count]), CODE_SIGMA_DN)
        for s in range(n):
            white[j, s] = min(max(white[j, s] / sigma, -CLIP_SIGMAS), CLIP_SIGMAS)


@kernel
def sum_along(
    white: Float64, offsets_px: Float64, slopes: Float64, bends: Float64, along: Float64, counts: Float64
) -> None:
    """Sum columns (m, n) along lines of slopes (k,), bent by (m,), that meet the stripe in each scan line.

    Writes the sums over the roots of how many columns they are of, and these counts, (k, n) both.
    """
    n = white.shape[1]
    for a in range(slopes.shape[0]):
        for s in range(n):
            along[a, s], counts[a, s] = 0.0, 0.0
        for j in range(white.shape[0]):
            away = slopes[a] * offsets_px[j] + bends[j]
            whole = math.floor(away)
            share = away - whole
            for s in range(max(0, -whole), min(n, n - 1 - whole)):
                value = (1.0 - share) * white[j, s + whole] + share * white[j, s + whole + 1]
                if not math.isnan(value):
                    along[a, s] += value
                    counts[a, s] += 1.0
        for s in range(n):
            along[a, s] /= math.sqrt(max(counts[a, s], 1.0))


def _energy(along: Float64, is_valid: Bool, width: float, only_dark: bool) -> Float64:
    """Return the chi^2 (k, n) of an even and an odd filter over sums (k, n), 0 where they are unknown.

    Of lines that are `only_dark` the even filter alone tells a slit from a streak's flank.
    """
    half = math.ceil(4.0 * width)
    x = np.arange(-half, half + 1) / width
    bell = np.exp(-0.5 * x * x)
    even, odd = (x**4 - 6.0 * x**2 + 3.0) * bell, (x**3 - 3.0 * x) * bell
    energy = np.zeros_like(along)
    is_valid = is_valid & (np.arange(along.shape[1]) >= half) & (np.arange(along.shape[1])[::-1] >= half)
    if not is_valid.any():
        return energy
    for shape in (even,) if only_dark else (even, odd):
        response = np.array([np.correlate(line, shape, "same") for line in along])
        sigma = MAD_SIGMA * float(np.median(np.abs(response[is_valid])))
        energy += ((np.minimum(response, 0.0) if only_dark else response) / max(sigma, MIN_SIGMA)) ** 2
    return np.where(is_valid, energy, 0.0)


def _place(section: Section, sums: _Sums) -> ImageLine | None:
    """Return the strongest line within a section's reach, and its margin over what lies elsewhere."""
    points = in_scan_order(section.points)
    scan = points[SCAN]
    order = slice(None, None, 1 if scan[0] <= scan[-1] else -1)
    y_of_scan = np.interp(
        np.arange(sums.energy.shape[1]), scan[order], points[Y_MM, order], left=np.nan, right=np.nan
    )
    within = np.where(np.abs(y_of_scan) <= section.reach_mm, sums.energy, 0.0)
    slope, line = np.unravel_index(int(within.argmax()), within.shape)
    strongest = float(within[slope, line])
    if strongest == 0.0:
        return None
    # Where the line itself is summed skewed it shows too.
    fan = float(np.ptp(sums.slopes)) * float(np.abs(sums.offsets_px).max())
    same = math.ceil(4.0 * sums.width + 0.5 * fan)
    is_elsewhere = np.abs(np.arange(sums.energy.shape[1]) - line) > same
    rival = float(sums.energy[:, is_elsewhere].max(initial=0.0))
    is_valid = (sums.energy > 0.0).any(axis=0)
    places = max(is_valid.sum() / sums.width, 1.0) * len(sums.slopes)
    within_share = float((within > 0.0).any(axis=0).sum() / is_valid.sum())
    wider = max(1.0, rival / (2.0 * math.log(places)))
    evidence = 0.5 * strongest / wider - math.log(max(places * within_share, 1.0))
    if rival > MAX_RIVAL**2 * strongest:
        evidence = min(evidence, 0.0)
    course = _crossing(sums, int(slope), int(line))
    if course is None:
        return None
    crossing, sigma = course
    y_mm = float(np.interp(crossing, np.arange(len(y_of_scan)), y_of_scan))
    return ImageLine(y_mm, sigma * section.column_mm, evidence)


def _crossing(sums: _Sums, slope: int, line: int) -> tuple[float, float] | None:
    """Return in which scan line a line meets the stripe, and its 1 sigma; None if too few pieces show it.

    A dark line beside a bright one may be no more than that one's flank.
    """
    half = math.ceil(4.0 * sums.width)
    n = sums.along.shape[1]
    if line < 2 * half or line + 2 * half >= n:
        return None
    section = sums.along[slope, line - half : line + half + 1]
    shown = _along(sums, sums.white, slope, line, math.floor(2.0 * sums.width))
    middle, own_variance = _middle(np.nansum(shown, axis=0) / math.sqrt(len(shown)))
    n_columns = len(sums.offsets_px)
    fitted = [
        piece
        for columns in np.array_split(np.arange(n_columns), min(N_PIECES, n_columns))
        if (piece := _piece(sums, columns, slope, line, section)) is not None
    ]
    if len(fitted) < MIN_PIECES:
        return None
    offset, shift, sigma = np.array(fitted).T
    far = float(np.abs(sums.offsets_px).max())
    t = offset / far
    # A circle of the radius R leaves its tangent by s^2 / 2 R.
    bow = 0.5 * ALONG_MM**2 / MIN_RADIUS_MM / sums.column_mm
    design = np.column_stack([np.ones_like(t), t, t * t])
    prior = np.diag([0.0, 0.0, bow**-2])
    weights = np.ones(len(t))
    # Rounds of the parabola's fit by Tukey's weights.
    for _ in range(5):
        H = (design.T * (weights / sigma**2)) @ design + prior
        p = np.linalg.solve(H, design.T @ (weights * shift / sigma**2))
        off = (shift - design @ p) / sigma
        scale = max(1.0, MAD_SIGMA * float(np.median(np.abs(off))))
        weights = np.maximum(1.0 - (off / (BISQUARE_WIDTH * scale)) ** 2, 0.0) ** 2
    variance = scale**2 * float(np.linalg.inv(H)[0, 0]) + own_variance
    return line + float(p[0]) + middle, math.sqrt(variance)


def _along(
    sums: _Sums, light: Float64, slope: int, line: int, reach: int, columns: Int64 | slice = slice(None)
) -> Float64:
    """Return columns of a light (m, n_scan) along a line and beside it, (k, 2 reach + 1)."""
    away, lines = sums.slopes[slope] * sums.offsets_px + sums.bends, np.arange(light.shape[1])
    x = line + np.arange(-reach, reach + 1)
    pairs = zip(away[columns], light[columns], strict=True)
    return np.array([np.interp(x + off, lines, column) for off, column in pairs])


def _middle(section: Float64) -> tuple[float, float]:
    """Return the seam's place in a line's section (n,), lines from its middle, and its variance.

    A gap is dark. A rim that shines is one plate's, next to it: it stands for a slit that is not seen.
    """
    x = np.arange(len(section)) - len(section) // 2
    dark, bright = np.maximum(-section, 0.0), np.maximum(section, 0.0)
    low, high = (share * float(bright.max()) for share in DARK_SHARES)
    places = []
    # Least contrast of a slit that is distinct from the plates: below it the rim stands for the slit.
    if dark.max() >= max(4.0, low):
        places.append(dark**2 / np.sum(dark**2))
    if not places or dark.max() < high:
        fitted = bright if bright.any() else np.ones(len(section))
        places.append(fitted**2 / np.sum(fitted**2))
    share = np.mean(places, axis=0)
    middle = float(share @ x)
    return middle, float(share @ (x - middle) ** 2)


def _piece(
    sums: _Sums, columns: Int64, slope: int, line: int, section: Float64
) -> tuple[float, float, float] | None:
    """Return a piece's distance from the stripe, px, its shift off a straight line, its 1 sigma, scan lines.

    None where the piece does not show the line.
    """
    half = len(section) // 2
    light = _along(sums, sums.read, slope, line, 2 * half, columns).sum(axis=0) / math.sqrt(len(columns))
    expected = section * math.sqrt(len(columns) / len(sums.offsets_px))
    fit = np.correlate(light, expected, "valid")
    best = int(fit.argmax())
    # A piece in which the line stands out less does not show it.
    if not (0 < best < len(fit) - 1 and fit[best] >= 2.0 * np.linalg.norm(expected)):
        return None
    before, peak, behind = fit[best - 1 : best + 2]
    shift = best - half + 0.5 * (before - behind) / (before - 2.0 * peak + behind)
    sigma = 1.0 / float(np.linalg.norm(np.gradient(expected)))
    return float(sums.offsets_px[columns].mean()), float(shift), sigma
