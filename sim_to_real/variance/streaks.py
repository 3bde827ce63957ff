"""Streaks: bright lines in single frames that are not noise, the model's own lines or persistent.

A line of the binned image is a streak if it is brighter than both its sides by more than noise and the
model's own lines near by allow, and if no other frame has such a line at the same place of the image or of
the part.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import find_objects, label
from scipy.special import ndtr
from scipy.stats import norm

from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from noise_model.instrument.sensor import linearise, respond, respond_moments, saturation_dn
from noise_model.surface.joint import seam_frame
from noise_model.transforms import invert, transform
from sim_to_real.data.binned import FLOOR_DN, FLOOR_REL, ObservedFrame, ObservedRecording
from sim_to_real.data.blocks import block_means, dilate
from sim_to_real.fit.frame_light import FrameLight
from sim_to_real.variance.haar_details import VarianceSizes

N_ANGLES = 8
"""Directions that are tried, evenly over half a turn."""

LENGTH_PX, SPACING_PX = 5, 3
"""Length of a line, and distance of the parallels next to it, pixels of the image."""

BLUR_PX = 0.65
"""1 sigma of a line's blur: an oblique line without blur would break into beads."""


@dataclass(frozen=True, eq=False)
class LineResponse:
    """Responses (N_ANGLES, h, w), in the image's unit, of lines about each pixel."""

    bright: Float32
    dark: Float32


def line_kernels() -> Float32:
    """Return the mean along a line, with a Gaussian's blur, as kernels (N_ANGLES, k, k)."""
    reach = LENGTH_PX // 2 + math.ceil(3.0 * BLUR_PX)
    row, column = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    angle = (math.pi * np.arange(N_ANGLES) / N_ANGLES)[:, np.newaxis, np.newaxis]
    along = column * np.cos(angle) + row * np.sin(angle)
    across = row * np.cos(angle) - column * np.sin(angle)
    box = ndtr((along + 0.5 * LENGTH_PX) / BLUR_PX) - ndtr((along - 0.5 * LENGTH_PX) / BLUR_PX)
    kernels = box * np.exp(-0.5 * (across / BLUR_PX) ** 2)
    return np.asarray(kernels / kernels.sum(axis=(1, 2), keepdims=True), dtype=np.float32)


KERNELS = line_kernels()
"""Means along a line in every direction (N_ANGLES, k, k)."""

NOISE_GAIN = float(np.sqrt(2.0 * np.max(np.sum(KERNELS**2, axis=(1, 2)))))
"""1 sigma of the difference of two lines' means, over that of a pixel."""


def line_response(image: Float32) -> LineResponse:
    """Return the line responses of an image (h, w); -inf where a parallel lies beyond the rim.

    The mean along a short line is compared with those along two parallels, one on either side,

        bright = L - max(L_left, L_right),    dark = min(L_left, L_right) - L,

    the brighter side being the one that counts (Tupin, Maitre, Mangin, Nicolas and Pechersky 1998, IEEE
    Trans. Geosci. Remote Sens. 36, 434). A slope, an edge of a face and that of a shadow are no line: one
    side is as bright. What noise alone makes of either is no larger than the difference of two such means.
    """
    h, w = image.shape
    bright = np.full((N_ANGLES, h, w), -np.inf, dtype=np.float32)
    dark = bright.copy()
    for n, kernel in enumerate(KERNELS):
        mean = np.asarray(
            cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32
        )
        angle = math.pi * n / N_ANGLES
        x, y = round(-SPACING_PX * math.sin(angle)), round(SPACING_PX * math.cos(angle))
        rows, columns = slice(abs(y), h - abs(y)), slice(abs(x), w - abs(x))
        line, one_side, other_side = (
            mean[abs(y) + by * y : h - abs(y) + by * y, abs(x) + by * x : w - abs(x) + by * x]
            for by in (0, 1, -1)
        )
        bright[n, rows, columns] = line - np.maximum(one_side, other_side)
        dark[n, rows, columns] = np.minimum(one_side, other_side) - line
    return LineResponse(bright, dark)


@dataclass(frozen=True, eq=False)
class StreakLine:
    """A line that was found: the position of its frame, its bins (k, 2), peak place, direction and response.

    `extent` is the length, bins, over which it has half of its response.
    """

    position: int
    bins: npt.NDArray[np.intp]
    place: tuple[int, int]
    angle: int
    response_dn: float
    limit_dn: float
    extent: float


@dataclass(frozen=True, eq=False)
class LineSearch:
    """The search for lines in one frame.

    `light_dn` (h, w) is the background over black, `noise_dn` (h, w) a bin's noise, `own_dn` (h, w) the
    largest response that the model's own lines may give. A line must exceed `limit_dn` (h, w), inf where
    nothing is searched. `stripe` (h, w) are the bins about the laser's, `bright` and `dark` the responses
    (N_ANGLES, h, w).
    """

    light_dn: Float32
    noise_dn: Float32
    own_dn: Float32
    limit_dn: Float32
    stripe: Bool
    bright: Float32
    dark: Float32


def search_lines(
    observed: ObservedRecording, lights: Sequence[FrameLight], sizes: VarianceSizes, more_dn2: float = 0.0
) -> list[LineSearch]:
    """Return the search for lines in each frame; `sizes` are those of the other random effects.

    `more_dn2` is the variance that compression adds to every bin.
    """
    n_trials = len(observed.frames) * observed.frames[0].keep.size * N_ANGLES
    # Noise alone gives a thousandth of a line in a whole recording.
    min_sigmas = float(norm.isf(1e-3 / n_trials))
    return [
        _search_frame(frame, light, sizes, more_dn2, min_sigmas, observed.bin_px)
        for frame, light in zip(observed.frames, lights, strict=True)
    ]


def _search_frame(
    frame: ObservedFrame,
    light: FrameLight,
    sizes: VarianceSizes,
    more_dn2: float,
    min_sigmas: float,
    bin_px: int,
) -> LineSearch:
    # The model's lines may lie three bins off the true ones.
    around_bins = 3
    sensor, around = light.sensor, np.ones((2 * around_bins + 1,) * 2, dtype=np.uint8)
    # A bright area of this width is no streak, and part of the background.
    wide_bins = 5
    seen_dn = np.asarray(cv2.medianBlur(frame.binned_dn, wide_bins), dtype=np.float32)
    light_dn = seen_dn - np.float32(sensor.black_level_dn)
    noise_dn = np.hypot(_noise_dn(frame, light, seen_dn, sizes, bin_px), np.float32(math.sqrt(more_dn2)))
    floor_dn = np.hypot(FLOOR_REL * light_dn, FLOOR_DN)
    own = line_response(respond(frame.stated_e, sensor).astype(np.float32))
    own_lines = np.maximum(np.maximum(own.bright, own.dark).max(axis=0), 0.0)
    # A line up to 1.5 times the model's own may be the model's error.
    own_dn = np.asarray(1.5 * cv2.dilate(own_lines, around), dtype=np.float32)
    limit_dn = np.asarray(min_sigmas * NOISE_GAIN * np.hypot(noise_dn, floor_dn) + own_dn, dtype=np.float32)
    full = block_means(frame.image_dn >= saturation_dn(sensor), bin_px) > 0.0
    # An area that is saturated across several bins is no streak.
    wide = cv2.morphologyEx(full.astype(np.uint8), cv2.MORPH_OPEN, np.ones((wide_bins, wide_bins), np.uint8))
    limit_dn[dilate(wide > 0, 2 * around_bins + 1)] = np.inf
    stripe = np.zeros(frame.keep.shape, dtype=np.bool_)
    stripe[frame.keep] = frame.in_stripe
    stripe = dilate(stripe, 2 * around_bins + 1)
    responses = line_response(frame.binned_dn)
    return LineSearch(light_dn, noise_dn, own_dn, limit_dn, stripe, responses.bright, responses.dark)


def _noise_dn(
    frame: ObservedFrame, light: FrameLight, seen_dn: Float32, sizes: VarianceSizes, bin_px: int
) -> Float32:
    """Return the noise (h, w) of bins with other random effects; a speckle grain counts as a whole bin."""
    electrons = np.maximum(linearise(seen_dn, light.sensor), 0.0)
    read_e2 = (1.0 + max(sizes.read, 0.0)) * light.sensor.read_noise_e**2
    laser_e = np.zeros(frame.keep.shape)
    laser_e[frame.keep] = light.laser_e
    grains_e2 = max(sizes.laser_small, sizes.laser_large) * laser_e**2
    noise_e2 = electrons + read_e2 + sizes.light * electrons**2 + bin_px**2 * grains_e2
    return np.asarray(
        np.sqrt(respond_moments(electrons, noise_e2, light.sensor)[1]) / bin_px, dtype=np.float32
    )


def transient_lines(
    observed: ObservedRecording, searched: Sequence[LineSearch]
) -> tuple[list[StreakLine], list[StreakLine]]:
    """Return the bright and the dark lines that only single frames have."""
    bright, dark = [], []
    for n, frame_search in enumerate(searched):
        bright += lines_in_frame(n, frame_search.bright, frame_search.limit_dn)
        dark += lines_in_frame(n, frame_search.dark, frame_search.limit_dn)
    dark = _drop(dark, is_next_to_bright(observed, dark, bright))
    return (
        _drop(bright, is_persistent(observed, searched, bright, dark=False)),
        _drop(dark, is_persistent(observed, searched, dark, dark=True)),
    )


def _drop(candidates: Sequence[StreakLine], dropped: Bool) -> list[StreakLine]:
    return [line for line, drops in zip(candidates, dropped, strict=True) if not drops]


def lines_in_frame(position: int, responses: Float32, limit_dn: Float32) -> list[StreakLine]:
    """Return the lines of one sign in a frame."""
    best = responses.max(axis=0)
    patches, _ = label(best > 0.5 * limit_dn, np.ones((3, 3)))
    lines_found = []
    for n, window in enumerate(find_objects(patches), 1):
        inside = patches[window] == n
        over = np.divide(best[window], limit_dn[window], out=np.zeros(inside.shape), where=inside)
        if over.max() <= 1.0 or inside.sum() < 3:
            continue
        first = np.array([window[0].start, window[1].start])
        row, column = first + np.unravel_index(int(np.argmax(over)), over.shape)
        response_dn = float(best[row, column])
        core = np.argwhere(inside & (best[window] > 0.5 * response_dn))
        lines_found.append(
            StreakLine(
                position,
                first + np.argwhere(inside),
                (int(row), int(column)),
                int(np.argmax(responses[:, row, column])),
                response_dn,
                float(limit_dn[row, column]),
                float(np.hypot(*np.ptp(core, axis=0))) + 1.0,
            )
        )
    return lines_found


def is_next_to_bright(
    observed: ObservedRecording, dark: Sequence[StreakLine], bright: Sequence[StreakLine]
) -> Bool:
    """Return the mask (n,) of dark lines next to a bright one.

    On a slope of light, the darker side of a bright line has a brighter neighbour on both sides.
    """
    near = np.zeros((len(observed.frames), *observed.frames[0].keep.shape), dtype=np.bool_)
    for line in bright:
        near[(line.position, *line.bins.T)] = True
    # Three bins beside a bright line may look like a dark line.
    near = np.stack([dilate(image, 7) for image in near])
    return np.array([near[(line.position, *line.bins.T)].any() for line in dark], dtype=bool)


def is_persistent(
    observed: ObservedRecording, searched: Sequence[LineSearch], candidates: Sequence[StreakLine], dark: bool
) -> Bool:
    """Return the mask (n,) of lines that recur in other frames at the same place of image or part."""
    lasts = np.zeros(len(candidates), dtype=bool)
    if not candidates:
        return lasts
    around = np.ones((5, 5), dtype=np.uint8)
    responses = []
    for frame_search in searched:
        best = np.stack([cv2.dilate(r, around) for r in (frame_search.dark if dark else frame_search.bright)])
        responses.append(np.maximum(best, np.maximum(np.roll(best, 1, axis=0), np.roll(best, -1, axis=0))))
    position = np.array([line.position for line in candidates])
    angle = np.array([line.angle for line in candidates])
    place = np.array([line.place for line in candidates])
    response = np.array([line.response_dn for line in candidates])
    light = np.array([searched[line.position].light_dn[line.place] for line in candidates])
    on_part = _points_on_part(observed, candidates)
    for fixed in (None, on_part):
        could, does = np.zeros(len(candidates)), np.zeros(len(candidates))
        for n, (frame, frame_search) in enumerate(zip(observed.frames, searched, strict=True)):
            there = place if fixed is None else _project_to_bins(observed, frame, fixed)
            inside = np.all((there >= 0) & (there < frame_search.light_dn.shape), axis=1)
            row, column = np.where(inside[:, np.newaxis], there, 0).T
            lighter = frame_search.light_dn[row, column] / np.maximum(light, 0.5)
            # It recurs with 30 % of its response, within two bins.
            expected = 0.3 * response * np.clip(lighter, 0.0, 1.0)
            shows = inside & (position != n) & np.isfinite(frame_search.limit_dn[row, column])
            # The stripe is a line, but not in all frames.
            shows &= expected > 3.0 * NOISE_GAIN * frame_search.noise_dn[row, column]
            shows &= ~frame_search.stripe[row, column]
            could += shows
            does += shows & (responses[n][angle, row, column] > expected)
        # Persistent: in 30 % of the frames that could show it, and in two of them if there are two.
        needed = np.maximum(0.3 * could, np.minimum(could, 2))
        lasts |= (could > 0) & (does >= needed)
    return lasts


def _points_on_part(observed: ObservedRecording, candidates: Sequence[StreakLine]) -> Float64:
    """Return the lines' places (n, 3) on the part's plane, mm, base frame."""
    camera, joint = observed.binned.camera, observed.setup.joint
    points = np.empty((len(candidates), 3))
    for n, line in enumerate(candidates):
        T_base_tool = observed.frames[line.position].T_base_tool_in(observed.binned)
        T_base_joint = seam_frame(joint, T_base_tool[:3, 3])
        T_base_camera = T_base_tool @ camera.T_tool_camera
        ray = T_base_camera[:3, :3] @ np.append(camera.normalised([line.place[::-1]])[0], 1.0)
        normal, origin = T_base_joint[:3, 2], T_base_camera[:3, 3]
        points[n] = origin + ray * ((T_base_joint[:3, 3] - origin) @ normal) / (ray @ normal)
    return points


def _project_to_bins(observed: ObservedRecording, frame: ObservedFrame, points: Float64) -> Int64:
    """Return the bins (n, 2), row and column, in which a frame sees points (n, 3), mm, base frame."""
    T_camera_base = invert(frame.T_base_tool_in(observed.binned) @ observed.binned.camera.T_tool_camera)
    uv = observed.binned.camera.project(transform(T_camera_base, points))
    return np.rint(np.clip(uv[:, ::-1], -1e6, 1e6)).astype(np.int64)
