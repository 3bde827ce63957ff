"""What speckle does to a stripe: in recorded frames, and in frames that are drawn of their setup.

    python benchmarks/speckle.py RECORDING... [--frames N] [--contrast C]

Each scan line's brightness and centroid are taken in a window about the brightest place, its background off.
Told are the stripe's 1 sigma, the contrast of the brightness from line to line about the lines nearby, how
alike neighbours are, and how far centres scatter about a line through those nearby. Frames are drawn at the
recording's poses, the laser alone, with the speckle that the setup's optics make, or of another contrast.
Saturated lines count for nothing.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.signal import savgol_filter

from arctrack.recording import BadFrame, read_recording
from noise_model.compiled.arrays import Float64, Integers
from noise_model.condition import Condition
from noise_model.forward import Renderer, draw_frame
from noise_model.instrument.sensor import linearise, saturation_dn
from noise_model.plan.noise import expected_speckle
from noise_model.setup import Setup
from noise_model.stripe import stripe_runs_along_rows

NEARBY_LINES = 21
"""Over so many scan lines brightness and centre are smoothed."""

WINDOW_SIGMAS, DIM = 3.0, 0.15
"""How far to either side a line is read; lines below this share of the median brightness are none."""


@dataclass(frozen=True)
class Lines:
    """A stripe's scan lines in order (n,): brightness, e-, centroid, px, 1 sigma, px; NaN where unread."""

    brightness_e: Float64
    center_px: Float64
    sigma_px: Float64


def lines_of(image_dn: Integers, setup: Setup, sigma_px: float) -> Lines:
    """Read a stripe of about this 1 sigma, line by line."""
    lines_dn = image_dn.T if stripe_runs_along_rows(setup) else image_dn
    charge_e = linearise(lines_dn, setup.sensor)
    charge_e = charge_e - np.median(charge_e, axis=1, keepdims=True)
    rough = median_filter(gaussian_filter1d(charge_e, sigma_px, axis=1).argmax(axis=1), NEARBY_LINES)
    places = np.arange(charge_e.shape[1])
    near = np.abs(places - rough[:, np.newaxis]) <= max(WINDOW_SIGMAS * sigma_px, 2.0)
    weight = np.where(near, charge_e, 0.0)
    brightness = weight.sum(axis=1)
    read = brightness > DIM * np.median(brightness)
    read &= ~((lines_dn >= saturation_dn(setup.sensor)) & near).any(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        center = (weight @ places) / brightness
        spread = (weight * (places - center[:, np.newaxis]) ** 2).sum(axis=1) / brightness
    sigma = np.sqrt(np.maximum(spread, 0.0))
    return Lines(*(np.where(read, values, np.nan) for values in (brightness, center, sigma)))


def scatter_of(lines: Lines) -> tuple[float, float, float]:
    """Return contrast, correlation of neighbours' brightness and scatter of centres, px, of a frame."""
    known = np.isfinite(lines.center_px)
    if known.sum() < 3 * NEARBY_LINES:
        return np.nan, np.nan, np.nan
    n = np.arange(len(known))
    bright, center = (np.interp(n, n[known], v[known]) for v in (lines.brightness_e, lines.center_px))
    off = [v - savgol_filter(v, NEARBY_LINES, 2) for v in (bright, center)]
    relative = off[0] / savgol_filter(bright, NEARBY_LINES, 2)
    both = known[1:] & known[:-1]
    alike = np.mean(relative[1:][both] * relative[:-1][both]) / np.mean(relative[known] ** 2)
    # Outliers are glints, not scatter.
    scatter = 1.4826 * float(np.median(np.abs(off[1][known])))
    return float(np.std(relative[known])), float(alike), scatter


def tell(name: str, frames: list[Integers], setup: Setup) -> None:
    """Print what the stripes of some frames are like."""
    sigma_px = 2.0
    for _ in range(2):
        lines = [lines_of(frame, setup, sigma_px) for frame in frames]
        sigma_px = float(np.nanmedian([np.nanmedian(one.sigma_px) for one in lines]))
    contrast, alike, scatter = np.nanmedian([scatter_of(one) for one in lines], axis=0)
    read = np.mean([np.isfinite(one.center_px).mean() for one in lines])
    print(f"{name:34} {sigma_px:6.2f} {contrast:9.2f} {alike:10.2f} {scatter:11.3f} {100 * read:5.0f} %")


def main() -> None:
    """Read and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--contrast", type=float)
    options = parser.parse_args()
    print(f"{'':34} {'sigma':>6} {'contrast':>9} {'neighbours':>10} {'scatter, px':>11} {'lines':>7}")
    for path in options.recordings:
        recording = read_recording(path, must_fit=False)
        buffer, setup = recording.pose_buffer(), recording.setup
        frames = [f for f in recording.frames() if not isinstance(f, BadFrame) and f.laser_on]
        frames = frames[:: max(1, len(frames) // options.frames)][: options.frames]
        tell(path.name, [frame.image_dn for frame in frames], setup)
        speckle = expected_speckle(setup)
        if options.contrast is not None:
            speckle["contrast"] = options.contrast
        speckled = replace(setup, effects={**setup.effects, "laser_speckle": speckle})
        rng, renderer, drawn = np.random.default_rng(0), Renderer(), []
        for frame in frames:
            pose = recording.pose_at(buffer, frame.timestamp_s)
            if pose is not None:
                on = Condition(1.0, 0.0, setup.camera.exposure_s)
                drawn.append(draw_frame(speckled, pose.T_base_tool, on, rng, renderer=renderer, part_seed=0))
        stated = f"drawn, C {speckle['contrast']:.2f}, grain {speckle['grain_px']:.2f} px"
        tell(stated, drawn, setup)


if __name__ == "__main__":
    main()
