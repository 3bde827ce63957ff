"""The stripe's light in each scan line of a board: how wide it is, and how much of it there is.

Squares reflect more light or less. The image without the laser says how much, so that the laser's
light on the board is a r(u) exp(-1/2 ((u - u0) / s)²): r is the room light that a pixel reflects, s the
stripe's sigma.
"""

from dataclasses import dataclass, replace

import numpy as np

from calibration.laser.stripe import BoardStripe, LaserLight
from noise_model.compiled.arrays import Bool, Float64, Int64, Integers

REACH = 4.0
"""Half-width of the stripe's window, in sigmas."""

STEPS, LONGEST = 12, 0.5
"""Gauss-Newton's steps for a line's width, and the longest, of place over sigma and of ln sigma."""

MAX_WIDTH_RATIO = 4.0
"""Ratio of a line's width to the expected one, either way, at which it is something else."""

DARK = 0.02
"""Pixels reflect this share of the brightest ones' light at least."""


@dataclass(frozen=True)
class CrossSections:
    """A stripe's light in each of n scan lines over the whole board.

    `places_px` is the stripe's curve; `aside_px` is the stripe's displacement from it, which squares' edges
    do not bias to the light side as they do a centroid. `width_px` is 1 sigma of the stripe in the image,
    blur included. Both are NaN where not determined. `amount` is the laser's light over the room's; its sigma
    from the image's noise is infinite on dark squares, where stray light dominates. With `along_rows` scan
    lines are columns.
    """

    scan: Int64
    places_px: Float64
    along_rows: bool
    aside_px: Float64
    width_px: Float64
    amount: Float64
    amount_sigma: Float64

    def points_px(self, scan: Float64 | None = None, aside_px: float = 0.0) -> Float64:
        """Return image points (m, 2) at `aside_px` from the curve, at scan lines (m,), by default at all."""
        where = self.scan.astype(np.float64) if scan is None else scan
        places = np.interp(where, self.scan, self.places_px) + aside_px
        return np.column_stack([where, places] if self.along_rows else [places, where])


def cross_sections(
    seen: LaserLight, off_dn: Integers | Float64, on_dn: Integers, stripe: BoardStripe, black_dn: float = 0.0
) -> CrossSections | None:
    """Measure a stripe's cross-sections; None where too little of the board lies about the stripe.

    `off_dn` and `on_dn` (H, W) are the images without and with the laser; saturated pixels of the latter
    determine no width. `black_dn` is the code of no light.
    """
    room = np.maximum(off_dn.astype(np.float64) - black_dn, 0.0)
    top = float(np.quantile(room[seen.area], 0.95))
    reflects = np.maximum(room / max(top, 1.0), DARK)
    images = [seen.light_dn.astype(np.float64), seen.noise_dn.astype(np.float64), reflects]
    is_full = on_dn >= 0.98 * _last_code(on_dn)
    inside = seen.area
    if stripe.along_rows:
        images, is_full, inside = [image.T for image in images], is_full.T, inside.T
    scan, curve = _curve(stripe, inside)
    half = int(np.ceil(REACH * stripe.scale_px)) + 2
    first = np.rint(curve).astype(np.int64) - half
    columns = first[:, np.newaxis] + np.arange(2 * half + 1)
    is_within = (first >= 0) & (columns[:, -1] < inside.shape[1])
    scan, curve, columns = scan[is_within], curve[is_within], columns[is_within]
    whole = inside[scan[:, np.newaxis], columns].all(axis=1)
    scan, curve, columns = scan[whole], curve[whole], columns[whole]
    if not len(scan):
        return None
    light, noise, room_part = (image[scan[:, np.newaxis], columns] for image in images)
    offsets = columns - curve[:, np.newaxis]
    aside, width = _widths(light, noise, room_part, offsets, stripe.scale_px)
    shown = stripe.points_px[:, 0 if stripe.along_rows else 1]
    is_no_measure = is_full[scan[:, np.newaxis], columns].any(axis=1)
    is_no_measure |= (scan < shown.min()) | (scan > shown.max())
    aside[is_no_measure], width[is_no_measure] = np.nan, np.nan
    known = np.isfinite(width)
    typical = float(np.median(width[known])) if known.any() else stripe.scale_px
    shape = room_part * np.exp(-0.5 * (offsets / typical) ** 2)
    power = np.sum((shape / noise) ** 2, axis=1)
    amount = np.sum(light * shape / noise**2, axis=1) / power
    is_dark = np.median(room_part, axis=1) < 0.5
    amount_sigma = np.where(is_dark, np.inf, 1.0 / np.sqrt(power))
    return CrossSections(scan, curve, stripe.along_rows, aside, width, amount, amount_sigma)


def placed(stripe: BoardStripe, sections: CrossSections) -> BoardStripe:
    """Return a stripe whose points are where its cross-sections are, as far as these are determined."""
    column = 0 if stripe.along_rows else 1
    scan, place = stripe.points_px[:, column], stripe.points_px[:, 1 - column].copy()
    row = np.searchsorted(sections.scan, scan).clip(0, len(sections.scan) - 1)
    measured = sections.places_px[row] + sections.aside_px[row]
    is_measured = (sections.scan[row] == scan) & np.isfinite(measured)
    place[is_measured] = measured[is_measured]
    points = np.column_stack([scan, place] if stripe.along_rows else [place, scan])
    return replace(stripe, points_px=points)


def _last_code(image: Integers) -> float:
    """Return the last code of as many bits as the brightest pixel takes: 12 bits are kept in 16."""
    return float(2 ** max(8, int(image.max()).bit_length()) - 1)


def _curve(stripe: BoardStripe, inside: Bool) -> tuple[Int64, Float64]:
    """Return scan lines (n,) that show the board, and the stripe's place in each by its parabola."""
    column = 0 if stripe.along_rows else 1
    course = np.polynomial.Polynomial.fit(stripe.points_px[:, column], stripe.points_px[:, 1 - column], 2)
    scan = np.flatnonzero(inside.any(axis=1))
    return scan, np.asarray(course(scan), dtype=np.float64)


def _widths(
    light: Float64, noise: Float64, room: Float64, offsets: Float64, start_px: float
) -> tuple[Float64, Float64]:
    """Return each line's place and sigma (n,), px, by least squares; NaN where the stripe is not clear."""
    weight = 1.0 / noise
    n = len(light)
    place, ln_width = np.zeros(n), np.full(n, np.log(start_px))
    amount, sigma = np.zeros(n), np.full(n, np.inf)
    for _ in range(STEPS):
        width = np.exp(ln_width)[:, np.newaxis]
        z = (offsets - place[:, np.newaxis]) / width
        shape = room * np.exp(-0.5 * z**2) * weight
        power = np.maximum(np.sum(shape**2, axis=1), 1e-30)
        amount, sigma = np.sum(shape * light * weight, axis=1) / power, 1.0 / np.sqrt(power)
        size = amount[:, np.newaxis] * shape
        J = np.stack([shape, size * z, size * z**2], axis=2)
        H = np.einsum("nmi,nmj->nij", J, J)
        scale = 1.0 / np.sqrt(np.maximum(np.einsum("nii->ni", H), 1e-30))
        H = H * scale[:, :, np.newaxis] * scale[:, np.newaxis, :] + 1e-6 * np.eye(3)
        g = np.einsum("nmi,nm->ni", J, light * weight - size) * scale
        step = np.linalg.solve(H, g[:, :, np.newaxis])[:, :, 0] * scale
        place += width[:, 0] * step[:, 1].clip(-LONGEST, LONGEST)
        ln_width += step[:, 2].clip(-LONGEST, LONGEST)
        ln_width = ln_width.clip(*(np.log(start_px) + np.log(MAX_WIDTH_RATIO) * np.array([-1.0, 1.0])))
    width_px = np.exp(ln_width)
    # A line whose maximum is off the stripe's curve by more than its sigma shows something else.
    is_clear = (amount >= 8.0 * sigma) & (np.abs(place) <= width_px)
    is_clear &= np.abs(ln_width - np.log(start_px)) < 0.999 * np.log(MAX_WIDTH_RATIO)
    return np.where(is_clear, place, np.nan), np.where(is_clear, width_px, np.nan)
