"""Frames of even light, level by level, as the numbers that a photon transfer needs of them.

A level is one exposure, lit or dark, of two frames or more. What its frames scatter by in time is noise; what
their means have in common from level to level is the sensor's fixed pattern (EMVA Standard 1288, release 4).
Slow changes over the image are the light's, and are taken off by a box filter.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter, uniform_filter

from noise_model.compiled.arrays import Bool, Float32, Float64, Int64, Integers

BOX_PX = 11
"""The side of the box whose mean is taken off: the pattern of pixels stays, the light's slow change goes."""

MIN_SIDE_PX = 2 * BOX_PX
"""Smaller frames hold too few boxes: a box is left out along each border."""

FLICKER_SIGMAS = 5.0
"""Significance of a difference or a correlation, in standard errors."""


@dataclass(frozen=True, eq=False)
class Level:
    """Statistics of two or more frames of one exposure.

    `mean_dn` and `variance_dn2` (H, W) are each pixel's mean over the frames and its variance from frame to
    frame, without the frames' own brightness; `frame_means_dn` (L,) is that brightness, `histogram` (2^bits)
    counts each code. `neighbour_correlation` is the noise's, of adjacent pixels.
    """

    exposure_s: float
    is_lit: bool
    mean_dn: Float32
    variance_dn2: Float32
    frame_means_dn: Float64
    histogram: Int64
    neighbour_correlation: float

    @property
    def n_frames(self) -> int:
        """The number of frames."""
        return len(self.frame_means_dn)

    @property
    def name(self) -> str:
        """Light and exposure in words."""
        return f"{'flat' if self.is_lit else 'dark'} frames of {1e3 * self.exposure_s:g} ms"

    def share_from(self, code_dn: float) -> float:
        """Return the share of readings at or above a code."""
        return float(self.histogram[max(0, int(np.ceil(code_dn))) :].sum() / self.histogram.sum())


def level_from(frames_dn: Sequence[Integers], exposure_s: float, is_lit: bool, bits: int) -> Level:
    """Return a level's numbers from its frames (H, W); ValueError for one frame, and for unlike ones."""
    kind = f"{'flat' if is_lit else 'dark'} frames of {1e3 * exposure_s:g} ms"
    if len(frames_dn) < 2:
        raise ValueError(f"{kind}: there is one; noise takes two of the same light: add another")
    if len({frame.shape for frame in frames_dn}) > 1:
        raise ValueError(f"{kind}: they differ in size; leave out those of another camera or crop")
    if min(frames_dn[0].shape) < MIN_SIDE_PX:
        rows, columns = frames_dn[0].shape
        raise ValueError(f"{kind}: are of {columns} x {rows} px, {MIN_SIDE_PX} a side are needed: crop less")
    brightest = max(int(frame.max()) for frame in frames_dn)
    if brightest >= 2**bits:
        raise ValueError(f"{kind}: hold {brightest} DN, [sensor] bits = {bits} ends at {2**bits - 1}")
    depth = 8 * frames_dn[0].dtype.itemsize
    if depth < bits:
        raise ValueError(
            f"{kind}: hold {depth} bits, [sensor] bits = {bits}: record with all of them, or state {depth}"
        )
    _check_different(frames_dn, kind)
    stack = np.stack([_middle(frame) for frame in frames_dn]).astype(np.float64)
    means = stack.mean(axis=(1, 2))
    noise = stack - means[:, np.newaxis, np.newaxis]
    noise -= noise.mean(axis=0)
    variance = np.sum(noise**2, axis=0) / (len(stack) - 1)
    return Level(
        exposure_s,
        is_lit,
        stack.mean(axis=0).astype(np.float32),
        variance.astype(np.float32),
        means,
        np.bincount(stack.astype(np.int64).ravel(), minlength=2**bits),
        _neighbour_correlation(noise),
    )


def _check_different(frames_dn: Sequence[Integers], kind: str) -> None:
    """Raise ValueError for a frame that is there twice: noise makes no two equal, but saturation does."""
    if len({frame.tobytes() for frame in frames_dn}) == len(frames_dn):
        return
    codes = np.bincount(frames_dn[0].ravel())
    if codes.max() <= 0.5 * codes.sum():
        raise ValueError(f"{kind}: one of them is there twice, and a copy has no noise: leave it out")


def check_steady(level: Level, black_dn: float) -> None:
    """Raise ValueError for a light that flickers between a level's frames, and for frames that move."""
    means = level.frame_means_dn
    pixels = level.mean_dn.size
    error = float(np.sqrt(2.0 * level.variance_dn2.mean() / pixels)) + 1e-9
    spread = float(np.ptp(means))
    light = abs(float(means.mean()) - black_dn)
    # Differences of frames take off the mean; of a pattern of 1 % a flicker of 1 % leaves a ten-thousandth.
    if level.is_lit and spread > max(0.01 * light, FLICKER_SIGMAS * error):
        raise ValueError(
            f"{level.name}: one is {100.0 * spread / light:.1f} % brighter than another: the light "
            "flickers; take them anew under direct current, or with exposures of whole periods"
        )
    # Frames whose noise rounding swallows have no correlation to speak of.
    # Moving scenes, codecs and interpolated colours correlate neighbours by more.
    if abs(level.neighbour_correlation) > 0.05 + FLICKER_SIGMAS / np.sqrt(pixels):
        raise ValueError(
            f"{level.name}: neighbouring pixels differ alike from frame to frame (correlation "
            f"{level.neighbour_correlation:.2f}): camera or scene moved between them, or they are "
            "compressed or interpolated; take raw frames of a still, even surface"
        )


@dataclass(frozen=True, eq=False)
class LevelStatistics:
    """Levels (s,) without defect pixels: what the photon transfer is fitted to.

    `mean_dn`, `variance_dn2` and `n_frames` (s,); `spatial_dn2` (s, s) is the covariance of the levels' mean
    frames over the pixels, slow changes taken off; `exposure_s` (s,), `is_lit` (s,). `shading_rel` is by how
    much the light changes over the image, 1 sigma, relative.
    """

    exposure_s: Float64
    is_lit: Bool
    n_frames: Float64
    mean_dn: Float64
    variance_dn2: Float64
    spatial_dn2: Float64
    shading_rel: float
    n_pixels: int
    n_defects: int


def statistics(levels: Sequence[Level]) -> LevelStatistics:
    """Return the statistics of levels of one size, their defect pixels left out."""
    means = np.array([float(level.mean_dn.mean()) for level in levels])
    good = np.ones(levels[0].mean_dn.shape, dtype=np.bool_)
    for n in {int(np.argmin(means)), int(np.argmax(means))}:
        good &= _is_good(levels[n])
    # The mean over a box's good pixels: a defect must not spoil its neighbours.
    weight = uniform_filter(good.astype(np.float64), BOX_PX)
    slow = np.stack([uniform_filter(level.mean_dn * good, BOX_PX, np.float64) / weight for level in levels])
    n_defects = int((~good).sum())
    # A box that reaches past the border sees the light's slope as pattern.
    aside = BOX_PX // 2
    for border in (np.s_[:aside], np.s_[-aside:], np.s_[:, :aside], np.s_[:, -aside:]):
        good[border] = False
    kept = np.stack([level.mean_dn[good] for level in levels]) - slow[:, good]
    kept -= kept.mean(axis=1, keepdims=True)
    light = float(means.max() - means.min())
    return LevelStatistics(
        exposure_s=np.array([level.exposure_s for level in levels]),
        is_lit=np.array([level.is_lit for level in levels]),
        n_frames=np.array([float(level.n_frames) for level in levels]),
        mean_dn=np.array([float(level.mean_dn[good].mean(dtype=np.float64)) for level in levels]),
        variance_dn2=np.array([float(level.variance_dn2[good].mean(dtype=np.float64)) for level in levels]),
        spatial_dn2=kept @ kept.T / kept.shape[1] / (1.0 - 1.0 / BOX_PX**2),
        shading_rel=float(slow[int(np.argmax(means))][good].std() / light) if light > 0.0 else 0.0,
        n_pixels=int(good.sum()),
        n_defects=n_defects,
    )


def _is_good(level: Level) -> Bool:
    """Return the mask (H, W) of pixels without a defect in one level."""
    off = level.mean_dn - median_filter(level.mean_dn, 5)
    # The spread of the middle half: defects do not count in it, nor does a tail of rounded codes.
    low, above = np.percentile(off, [25.0, 75.0])
    noise = float(np.sqrt(np.mean(level.variance_dn2) / level.n_frames))
    return np.asarray(np.abs(off) <= 6.0 * max((above - low) / 1.349, noise, 1.0 / 12.0))


def _middle(frame: Integers) -> Integers:
    # A lens' light is most even in the middle: a square of 512 px is used.
    side_px = 512
    rows, columns = (slice((n - min(n, side_px)) // 2, (n + min(n, side_px)) // 2) for n in frame.shape)
    return frame[rows, columns]


def _neighbour_correlation(noise: Float64) -> float:
    power = float(np.mean(noise**2))
    if power == 0.0:
        return 0.0
    across = float(np.mean(noise[:, :, 1:] * noise[:, :, :-1]))
    along = float(np.mean(noise[:, 1:] * noise[:, :-1]))
    return max(across, along, key=abs) / power
