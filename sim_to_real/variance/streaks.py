"""Streaks: bright lines in single frames, told from noise, the model's own lines and all that lasts.

A line of the binned image is a streak's if it is brighter on both sides than noise and the model's own lines
near by allow, and if no such line stands at the same place of the image or of the part in other frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import find_objects, label
from scipy.stats import norm

from noise_model.arrays import Bool, Float32, Float64, Int64
from noise_model.instrument.sensor import linearise, respond, respond_moments, saturation_dn
from noise_model.surface.joint import seam_frame
from noise_model.transforms import invert, transform
from sim_to_real.data.binned import FLOOR_DN, FLOOR_REL, Observed, ObservedFrame
from sim_to_real.data.blocks import block_means, within
from sim_to_real.fit.linearized_model import Passed
from sim_to_real.variance.haar_details import Sizes
from sim_to_real.variance.line_filter import ANGLES, NOISE, ridges

FALSE_ALARMS = 1e-3
"""So many lines of noise alone are expected in a whole recording."""

WIDE = 5
"""Bins across what is no streak: saturated areas, the median that is a streak's background."""

MISPLACED = 3
"""Bins by which the model's lines may lie beside the true ones."""

TRUSTED = 1.5
"""Lines up to so many times the model's own may be what the model is off."""

RECURRING, NEAR = 0.3, 2
"""A line recurs if at its place, within so many bins, another frame has this share of it."""

OFTEN, TWICE = 0.3, 2
"""What recurs in this share of the frames that could show it lasts, if it does twice or wherever it could."""

LEAST_LIGHT_DN = 0.5
"""A line that lasts is fainter with the light about it, down to so little."""

BESIDE = 3
"""Bins within which a bright line makes its surroundings look like a dark one."""

CLEAR = 3.0
"""A frame could show a line again if that would stand out by so many sigmas."""

LEAST_BINS = 3
"""A line covers so many bins."""


@dataclass(frozen=True, eq=False)
class Line:
    """A line that stands out: its frame, the bins (k, 2) about it, its place there, direction and response.

    `extent` is its length in bins, where it has half of its response.
    """

    position: int
    bins: npt.NDArray[np.intp]
    place: tuple[int, int]
    angle: int
    response_dn: float
    limit_dn: float
    extent: float


@dataclass(frozen=True, eq=False)
class Searched:
    """A frame that was searched.

    `light_dn` (h, w) is its background over black, `noise_dn` (h, w) that of a bin, `own_dn` (h, w) what the
    model's own lines may make, `limit_dn` (h, w) what a line must exceed, inf where nothing is searched;
    `stripe` (h, w) are the bins about the laser's, `bright` and `dark` the responses (ANGLES, h, w).
    """

    light_dn: Float32
    noise_dn: Float32
    own_dn: Float32
    limit_dn: Float32
    stripe: Bool
    bright: Float32
    dark: Float32


def search(observed: Observed, passed: Sequence[Passed], sizes: Sizes) -> list[Searched]:
    """Return what stands out as a line in all frames; `sizes` are those of what scatters besides."""
    n_trials = len(observed.frames) * observed.frames[0].keep.size * ANGLES
    sure = float(norm.isf(FALSE_ALARMS / n_trials))
    return [
        _searched(frame, light, sizes, sure, observed.bin_px)
        for frame, light in zip(observed.frames, passed, strict=True)
    ]


def _searched(frame: ObservedFrame, light: Passed, sizes: Sizes, sure: float, bin_px: int) -> Searched:
    sensor, around = light.sensor, np.ones((2 * MISPLACED + 1,) * 2, dtype=np.uint8)
    seen_dn = np.asarray(cv2.medianBlur(frame.binned_dn, WIDE), dtype=np.float32)
    light_dn = seen_dn - np.float32(sensor.black_level_dn)
    noise_dn = _noise_dn(frame, light, seen_dn, sizes, bin_px)
    floor_dn = np.hypot(FLOOR_REL * light_dn, FLOOR_DN)
    own = ridges(respond(frame.stated_e, sensor).astype(np.float32))
    own_lines = np.maximum(np.maximum(own.bright, own.dark).max(axis=0), 0.0)
    own_dn = np.asarray(TRUSTED * cv2.dilate(own_lines, around), dtype=np.float32)
    limit_dn = np.asarray(sure * NOISE * np.hypot(noise_dn, floor_dn) + own_dn, dtype=np.float32)
    full = block_means(frame.image_dn >= saturation_dn(sensor), bin_px) > 0.0
    # What is saturated across several bins is no streak; narrower it may be one.
    wide = cv2.morphologyEx(full.astype(np.uint8), cv2.MORPH_OPEN, np.ones((WIDE, WIDE), np.uint8))
    limit_dn[within(wide > 0, 2 * MISPLACED + 1)] = np.inf
    stripe = np.zeros(frame.keep.shape, dtype=np.bool_)
    stripe[frame.keep] = frame.in_stripe
    stripe = within(stripe, 2 * MISPLACED + 1)
    found = ridges(frame.binned_dn)
    return Searched(light_dn, noise_dn, own_dn, limit_dn, stripe, found.bright, found.dark)


def _noise_dn(frame: ObservedFrame, light: Passed, seen_dn: Float32, sizes: Sizes, bin_px: int) -> Float32:
    """Return the noise (h, w) of bins, with what scatters besides; grains count as if a bin were one."""
    electrons = np.maximum(linearise(seen_dn, light.sensor), 0.0)
    read_e2 = (1.0 + max(sizes.read, 0.0)) * light.sensor.read_noise_e**2
    laser_e = np.zeros(frame.keep.shape)
    laser_e[frame.keep] = light.laser_e
    grains_e2 = max(sizes.laser_small, sizes.laser_large) * laser_e**2
    noise_e2 = electrons + read_e2 + sizes.light * electrons**2 + bin_px**2 * grains_e2
    return np.asarray(
        np.sqrt(respond_moments(electrons, noise_e2, light.sensor)[1]) / bin_px, dtype=np.float32
    )


def passing(observed: Observed, searched: Sequence[Searched]) -> tuple[list[Line], list[Line]]:
    """Return the bright and the dark lines that are in single frames."""
    bright = [line for n, of in enumerate(searched) for line in lines(n, of.bright, of.limit_dn)]
    dark = [line for n, of in enumerate(searched) for line in lines(n, of.dark, of.limit_dn)]
    dark = _but(dark, shadows(observed, dark, bright))
    return (
        _but(bright, lasting(observed, searched, bright, dark=False)),
        _but(dark, lasting(observed, searched, dark, dark=True)),
    )


def _but(found: Sequence[Line], dropped: Bool) -> list[Line]:
    return [line for line, drops in zip(found, dropped, strict=True) if not drops]


def lines(position: int, responses: Float32, limit_dn: Float32) -> list[Line]:
    """Return the lines of one sign in a frame."""
    best = responses.max(axis=0)
    patches, _ = label(best > 0.5 * limit_dn, np.ones((3, 3)))
    found = []
    for n, window in enumerate(find_objects(patches), 1):
        inside = patches[window] == n
        over = np.divide(best[window], limit_dn[window], out=np.zeros(inside.shape), where=inside)
        if over.max() <= 1.0 or inside.sum() < LEAST_BINS:
            continue
        first = np.array([window[0].start, window[1].start])
        row, column = first + np.unravel_index(int(np.argmax(over)), over.shape)
        response_dn = float(best[row, column])
        core = np.argwhere(inside & (best[window] > 0.5 * response_dn))
        found.append(
            Line(
                position,
                first + np.argwhere(inside),
                (int(row), int(column)),
                int(np.argmax(responses[:, row, column])),
                response_dn,
                float(limit_dn[row, column]),
                float(np.hypot(*np.ptp(core, axis=0))) + 1.0,
            )
        )
    return found


def shadows(observed: Observed, dark: Sequence[Line], bright: Sequence[Line]) -> Bool:
    """Return which dark lines (n,) lie beside a bright one.

    On a slope, what lies below a bright line is darker than the line and than what is above it.
    """
    near = np.zeros((len(observed.frames), *observed.frames[0].keep.shape), dtype=np.bool_)
    for line in bright:
        near[(line.position, *line.bins.T)] = True
    near = np.stack([within(image, 2 * BESIDE + 1) for image in near])
    return np.array([near[(line.position, *line.bins.T)].any() for line in dark], dtype=bool)


def lasting(observed: Observed, searched: Sequence[Searched], found: Sequence[Line], dark: bool) -> Bool:
    """Return which lines (n,) other frames show too, at the same place of the image or of the part."""
    lasts = np.zeros(len(found), dtype=bool)
    if not found:
        return lasts
    around = np.ones((2 * NEAR + 1,) * 2, dtype=np.uint8)
    responses = []
    for of in searched:
        best = np.stack([cv2.dilate(r, around) for r in (of.dark if dark else of.bright)])
        responses.append(np.maximum(best, np.maximum(np.roll(best, 1, axis=0), np.roll(best, -1, axis=0))))
    position = np.array([line.position for line in found])
    angle = np.array([line.angle for line in found])
    place = np.array([line.place for line in found])
    response = np.array([line.response_dn for line in found])
    light = np.array([searched[line.position].light_dn[line.place] for line in found])
    on_part = _on_part(observed, found)
    for fixed in (None, on_part):
        could, does = np.zeros(len(found)), np.zeros(len(found))
        for n, (frame, of) in enumerate(zip(observed.frames, searched, strict=True)):
            there = place if fixed is None else _seen_at(observed, frame, fixed)
            inside = np.all((there >= 0) & (there < of.light_dn.shape), axis=1)
            row, column = np.where(inside[:, np.newaxis], there, 0).T
            lighter = of.light_dn[row, column] / np.maximum(light, LEAST_LIGHT_DN)
            expected = RECURRING * response * np.clip(lighter, 0.0, 1.0)
            shows = inside & (position != n) & np.isfinite(of.limit_dn[row, column])
            # The stripe is a line itself, and not in all frames.
            shows &= (expected > CLEAR * NOISE * of.noise_dn[row, column]) & ~of.stripe[row, column]
            could += shows
            does += shows & (responses[n][angle, row, column] > expected)
        lasts |= (could > 0) & (does >= np.maximum(OFTEN * could, np.minimum(could, TWICE)))
    return lasts


def _on_part(observed: Observed, found: Sequence[Line]) -> Float64:
    """Return where the lines (n, 3) lie on the part's plane, mm, base frame."""
    camera, joint = observed.binned.camera, observed.setup.joint
    points = np.empty((len(found), 3))
    for n, line in enumerate(found):
        T_base_tool = observed.frames[line.position].T_base_tool_in(observed.binned)
        T_base_joint = seam_frame(joint, T_base_tool[:3, 3])
        T_base_camera = T_base_tool @ camera.T_tool_camera
        ray = T_base_camera[:3, :3] @ np.append(camera.normalised([line.place[::-1]])[0], 1.0)
        normal, origin = T_base_joint[:3, 2], T_base_camera[:3, 3]
        points[n] = origin + ray * ((T_base_joint[:3, 3] - origin) @ normal) / (ray @ normal)
    return points


def _seen_at(observed: Observed, frame: ObservedFrame, points: Float64) -> Int64:
    """Return the bins (n, 2), row and column, in which a frame sees points (n, 3), mm, base frame."""
    T_camera_base = invert(frame.T_base_tool_in(observed.binned) @ observed.binned.camera.T_tool_camera)
    uv = observed.binned.camera.project(transform(T_camera_base, points))
    return np.rint(np.clip(uv[:, ::-1], -1e6, 1e6)).astype(np.int64)
