"""Statistics of frames of a stripe that stands still, for the sensor's noise and the speckle.

A pixel's scatter from frame to frame is noise, once what all pixels share is removed: the laser's brightness
and small shifts of the whole image. Pixels are sorted by the mean of every second frame, and measured on the
others: noise that made a pixel look bright does not count as light.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, uniform_filter

from noise_model.compiled.arrays import Bool, Float32, Float64, Integers

MIN_FRAMES = 20
"""Least number of frames of a stripe that stands still."""

N_LEVELS, N_GRADIENTS, MIN_PIXELS = 20, 3, 60
"""Bins of brightness, bins of gradient within each, and the fewest pixels of a bin."""

DARK_PERCENTILE = 10.0
"""Percentile of the pixels' means that is the mean of pixels without light."""

FOOT_BOX_PX, FOOT_PX, MIN_DARK_SHARE = 5, 12, 0.01
"""Box of the mean that shows light, distance of dark pixels from it, px, and their least share."""

BOX_PX = 11
"""Dark pixels' means over such boxes say how even the dark is."""

CLEAR_SIGMAS = 4.0
"""Distance of a bin's mean from both ends of the scale, in sigmas of its noise."""


@dataclass(frozen=True, eq=False)
class StillStatistics:
    """Statistics of still frames.

    For each bin (b,): `mean_dn`, `variance_dn2` in time, the mean square `gradient_dn2` of the image's slope,
    DN^2 per px^2, and `n_pixels`; a pixel's variance has `freedom` degrees of freedom. `black_dn` is the mean
    of the darkest pixels, its 1 sigma and their variance; `image_dn` (H, W) the mean of all `n_frames`
    frames, `noise_dn2` (H, W) their variance, `is_usable` (H, W) those clear of saturation. `shifts_px` (n,
    2) and `brightness` (n,) are each frame's own.
    """

    mean_dn: Float64
    variance_dn2: Float64
    gradient_dn2: Float64
    n_pixels: Float64
    freedom: float
    black_dn: float
    black_sigma_dn: float
    dark_variance_dn2: float
    dark_sigma_dn2: float
    image_dn: Float64
    noise_dn2: Float64
    is_usable: Bool
    n_frames: int
    shifts_px: Float64
    brightness: Float64


def still_statistics(frames_dn: Sequence[Integers], top_dn: float) -> StillStatistics:
    """Return the numbers of frames (H, W); ValueError for too few, and for a stripe that moves or changes."""
    if len(frames_dn) < MIN_FRAMES:
        raise ValueError(
            f"{len(frames_dn)} frames show the stripe alone, {MIN_FRAMES} are needed: record more with the "
            "tool and the part at rest, the arc off"
        )
    stack = np.stack(frames_dn).astype(np.float32)
    image = stack.mean(axis=0, dtype=np.float64)
    shifts, sways, brightness = _subtract_common(stack, image)
    _check_still(shifts, sways, brightness)
    noise = stack.var(axis=0, ddof=1, dtype=np.float64)
    is_usable = (stack.max(axis=0) < top_dn) & (stack.min(axis=0) > 0.0)
    bins, darks = [], []
    for first in (0, 1):
        sorted_by, measured = stack[first::2], stack[1 - first :: 2]
        by = sorted_by.mean(axis=0, dtype=np.float64)
        mean = measured.mean(axis=0, dtype=np.float64)
        variance = measured.var(axis=0, ddof=1, dtype=np.float64)
        bins += _bins(by, mean, variance, len(sorted_by), top_dn)
        darks.append(_dark(by, mean, variance, len(measured)))
    if not bins:
        raise ValueError("no pixel keeps clear of both ends of the scale: change exposure or black level")
    means, variances, gradients, counts = np.array(bins).T
    black, black_sigma, dark, dark_sigma = np.array(darks).T
    return StillStatistics(
        mean_dn=means,
        variance_dn2=variances,
        gradient_dn2=gradients,
        n_pixels=counts,
        freedom=0.5 * len(stack) - 1.0,
        black_dn=float(black.mean()),
        black_sigma_dn=float(np.sqrt(0.5 * np.mean(black_sigma**2) + 0.25 * np.diff(black)[0] ** 2)),
        dark_variance_dn2=float(dark.mean()),
        dark_sigma_dn2=float(np.sqrt(0.5 * np.mean(dark_sigma**2))),
        image_dn=image,
        noise_dn2=noise,
        is_usable=np.asarray(is_usable),
        n_frames=len(stack),
        shifts_px=shifts,
        brightness=brightness,
    )


def slope_squared(image: Float64) -> Float64:
    """Return the square (H, W) of an image's slope, per px^2."""
    down, across = np.gradient(image)
    return np.asarray(down**2 + across**2)


def _subtract_common(stack: Float32, image: Float64) -> tuple[Float64, Float64, Float64]:
    """Take off, in place, what a frame's pixels share.

    Return shifts (n, 2), px, what they do to the light, relative (n,), and brightness (n,).
    """
    down, across = np.gradient(image)
    light = image - np.percentile(image, DARK_PERCENTILE)
    # Pixels brighter than a tenth of the stripe show what a frame's pixels share.
    share = 0.1
    is_bright = light > share * np.percentile(light, 99.9)
    # A camera that shakes moves all of the image, a laser its stripe under a speckle that stays.
    # The blur takes speckle off the stripe.
    smooth = gaussian_filter(np.maximum(light, 0.0), 3.0)
    slopes = np.stack(np.gradient(smooth)) * light / np.maximum(smooth, 0.1 * share * smooth.max())
    shapes = np.stack([light, down, across, *slopes, np.ones_like(image)])
    # Shot noise grows with the light: bright pixels count less.
    bright = shapes[:, is_bright]
    weighted = bright / light[is_bright]
    solve = np.linalg.pinv(weighted @ bright.T)
    shared, scatter = np.empty((len(stack), len(shapes))), 0.0
    for n, frame in enumerate(stack):
        off = (frame - image)[is_bright]
        shared[n] = solve @ (weighted @ off)
        scatter += float(np.mean((off - shared[n] @ bright) ** 2 / light[is_bright])) / len(stack)
        # The hall's light and the black level wander by themselves.
        offset = np.where(is_bright, shared[n, -1], float(np.mean((frame - image)[~is_bright])))
        frame -= (np.tensordot(shared[n, :-1], shapes[:-1], 1) + offset).astype(np.float32)
    # Without speckle both kinds of shift are told apart badly, and their sum well.
    both = np.kron(np.ones((1, 2)), np.eye(2))
    total = shared[:, 1:5] @ both.T
    sigma = np.sqrt(scatter * np.diag(both @ solve[1:5, 1:5] @ both.T))
    # A stripe that is hardly seen moves nowhere for certain; a wide one may move further.
    steepness = np.sqrt(np.mean(bright[3:5] ** 2, axis=1) / np.mean(bright[0] ** 2))
    sways = np.where(np.abs(total) > CLEAR_SIGMAS * sigma, np.abs(total), 0.0) * steepness
    return total, sways.max(axis=1), shared[:, 0]


def _check_still(shifts_px: Float64, sways: Float64, brightness: Float64) -> None:
    worst = int(np.argmax(sways))
    # A third of a pixel where the stripe's sigma is 4 px.
    if sways[worst] > 0.05:
        raise ValueError(
            f"the stripe does not stand still: in frame {worst} it is shifted by "
            f"{np.abs(shifts_px[worst]).max():.2f} px; record with tool and part at rest"
        )
    worst = int(np.argmax(np.abs(brightness)))
    if abs(brightness[worst]) > 0.2:
        raise ValueError(
            f"the light is not steady: frame {worst} is {100.0 * brightness[worst]:+.0f} % off the others; "
            "record under one laser power and one exposure, the arc off"
        )


def _bins(
    by: Float64, mean: Float64, variance: Float64, n_frames: int, top_dn: float
) -> list[tuple[float, float, float, float]]:
    """Return mean, variance, gradient and count of bins of brightness and, within these, of gradient."""
    gradient = slope_squared(by)
    black = float(np.percentile(uniform_filter(by, FOOT_BOX_PX), DARK_PERCENTILE))
    highest = float(np.percentile(by, 99.9))
    edges = np.concatenate(
        [[-np.inf], black + np.geomspace(1.0, max(highest - black, 2.0), N_LEVELS), [np.inf]]
    )
    level = np.digitize(by, edges) - 1
    bins = []
    for k in range(len(edges) - 1):
        members = np.flatnonzero(level.ravel() == k)
        if len(members) < MIN_PIXELS:
            continue
        sigma = float(np.sqrt(variance.ravel()[members].mean()))
        clear = by.ravel()[members]
        if clear.max() + CLEAR_SIGMAS * sigma > top_dn or clear.min() - CLEAR_SIGMAS * sigma < -0.5:
            continue
        parts = min(N_GRADIENTS, len(members) // MIN_PIXELS)
        order = members[np.argsort(gradient.ravel()[members], kind="stable")]
        for part in np.array_split(order, parts):
            # The mean's own noise has a slope: half of its variance along either axis.
            own = variance.ravel()[part].mean()
            slope = max(float(gradient.ravel()[part].mean() - own / n_frames), 0.0)
            bins.append((float(mean.ravel()[part].mean()), float(own), slope, float(len(part))))
    return bins


def _dark(by: Float64, mean: Float64, variance: Float64, n_frames: int) -> tuple[float, float, float, float]:
    """Return mean and variance of the pixels without light, and the 1 sigma of both."""
    smooth = uniform_filter(by, FOOT_BOX_PX)
    reference = float(np.percentile(smooth, DARK_PERCENTILE))
    near = np.abs(by - reference)
    noise = float(np.sqrt(np.median(variance[near <= np.percentile(near, DARK_PERCENTILE)]) + 1.0 / 12.0))
    is_dark = near <= noise
    # A stripe's foot is weak and wide: what lies near to light that shows in a small box does not count.
    shows = smooth - reference > 4.0 * noise / (FOOT_BOX_PX * np.sqrt(n_frames))
    aside = is_dark & ~maximum_filter(shows, 2 * FOOT_PX + 1)
    if aside.mean() > MIN_DARK_SHARE:
        is_dark = aside
    n = int(is_dark.sum())
    black, dark = float(mean[is_dark].mean()), float(variance[is_dark].mean())
    # Where boxes of dark pixels differ by more than their pixels do, the dark is uneven, and black unsure.
    share = uniform_filter(is_dark.astype(np.float64), BOX_PX)
    boxes = uniform_filter(np.where(is_dark, mean, 0.0), BOX_PX) / np.maximum(share, 1e-9)
    full = (share > 0.8) & is_dark
    pixel = float(mean[is_dark].var())
    uneven = 0.0
    if full.sum() > BOX_PX**2:
        # Beyond what the pixels' own scatter makes of so many boxes, by two of its standard errors.
        chance = pixel / BOX_PX**2 * float(np.mean(1.0 / share[full]))
        chance *= 1.0 + 2.0 * float(np.sqrt(2.0 * BOX_PX**2 / full.sum()))
        uneven = max(float(boxes[full].var()) - chance, 0.0)
    black_sigma = float(np.sqrt(pixel / n + uneven))
    return black, black_sigma, dark, dark * float(np.sqrt(2.0 / ((n_frames - 1.0) * n)))
