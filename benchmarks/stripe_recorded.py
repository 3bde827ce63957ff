"""The stripe's centre on recorded frames, beside what others read it with, at equal resolution along it.

    python benchmarks/stripe_recorded.py RECORDING... [--frames 20]

Steger's and sato's filters average along the stripe, ours and a centroid read line by line. So all centres
are smoothed along the stripe by a Gaussian until each has that of the widest filter, the stripe's own sigma.
Nobody knows the truth of a recorded frame. Told is, of the scan lines between the ends of the lit stripe:

- held: the share of lines with a centre;
- gross: the share of these beyond 2 sigmas of the stripe from the running median of all readers' median;
- along: 1 sigma of a centre about the straight line through those 4 sigmas before and behind it, px;
- still: 1 sigma from frame to frame where the sensor stood still, px; nan where it moved.

Of ours it is told how well its sigmas hold: 1 sigma of second differences, of lines and of means over 16,
over what their stated sigmas say. Lines and means lie too far apart to be off alike.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.ndimage import convolve1d, median_filter

import arctrack
from noise_model.compiled.arrays import Float64, Integers
from tracker.state import Frame, Pose
from tracker.stripe.expected import expect_stripe
from tracker.tracker import Tracker
from validation.bench.stripe_peers import centroid, ridge, steger

MEDIAN_LINES = 31
GROSS_SIGMAS, APART_SIGMAS = 2.0, 4.0
STILL_MM = 1e-3
STEGER_SHARE = 1.0 / math.sqrt(3.0)
"""Steger's filter for a stripe of a width has this share of it as its sigma."""

MEAN_LINES = 16
"""Over so many neighbours means are taken whose sigma is held against what is stated."""

Reader = Callable[[Integers, float], Float64]
PEERS: dict[str, tuple[Reader, float, float]] = {
    "steger": (steger, 1.0, STEGER_SHARE),
    "steger, half scale": (steger, 0.5, 0.5 * STEGER_SHARE),
    "sato": (ridge, 1.0, 1.0),
    "centroid": (centroid, 1.0, 0.0),
}
"""Each reader, the width that it is told, its own smoothing along: both over the stripe's sigma."""


def frames_of(folder: Path, most: int) -> list[tuple[Frame, Pose]]:
    """Return the last frames of a recording that show the laser, with their poses."""
    recording = arctrack.read_recording(folder)
    poses = recording.pose_buffer()
    frames = [frame for frame in recording.frames() if isinstance(frame, Frame) and frame.laser_on]
    pairs = [(frame, recording.pose_at(poses, frame.timestamp_s)) for frame in frames[-most:]]
    return [(frame, pose) for frame, pose in pairs if pose is not None]


def smoothed(centres_px: Float64, sigma_lines: float) -> Float64:
    """Return centres (n_frames, n_scan) smoothed along the stripe, lines without one left out."""
    reach = math.ceil(4.0 * sigma_lines)
    bell = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma_lines, 1e-6)) ** 2)
    held = np.isfinite(centres_px)
    total = convolve1d(np.where(held, centres_px, 0.0), bell, axis=1, mode="constant")
    weight = convolve1d(held.astype(float), bell, axis=1, mode="constant")
    with np.errstate(invalid="ignore"):
        return np.where(held, total / weight, np.nan)


def consensus(centres: dict[str, Float64]) -> Float64:
    """Return the running median (n_frames, n_scan) of the readers' median."""
    middle = np.nanmedian(np.array(list(centres.values())), axis=0)
    filled = np.array([_filled(line) for line in middle])
    return median_filter(filled, (1, MEDIAN_LINES), mode="nearest")


def _filled(line: Float64) -> Float64:
    held = np.flatnonzero(np.isfinite(line))
    return np.interp(np.arange(len(line)), held, line[held]) if len(held) else line


def pull(values: Float64, variances: Float64, apart: int) -> float:
    """Return 1 sigma of second differences so far apart along values (n_frames, n) over what is stated."""
    off = values[:, : -2 * apart] - 2.0 * values[:, apart:-apart] + values[:, 2 * apart :]
    stated = variances[:, : -2 * apart] + 4.0 * variances[:, apart:-apart] + variances[:, 2 * apart :]
    return 1.4826 * float(np.nanmedian(np.abs(off / np.sqrt(stated))))


def means(values: Float64) -> Float64:
    """Return the means (n_frames, n // MEAN_LINES) of neighbours; a mean without one of its lines is NaN."""
    n = values.shape[1] // MEAN_LINES
    return values[:, : n * MEAN_LINES].reshape(len(values), n, MEAN_LINES).mean(axis=2)


def width_of(tracker: Tracker) -> float:
    """Return the stripe's sigma, px, as the last frame was read."""
    reading = tracker.reading
    assert reading is not None
    expected = expect_stripe(tracker.geometry, reading.scene)
    assert expected is not None
    return float(np.median(expected.sigma_px)) * reading.scatter.width_factor


def tell(folder: Path, most: int) -> None:
    """Print one recording's table."""
    tracker = Tracker(arctrack.read_recording(folder).setup)
    along_rows = tracker.geometry.along_rows
    centres: dict[str, list[Float64]] = {name: [] for name in ("ours", *PEERS)}
    widths, places, own_px, beside_px = [], [], [], []
    pairs = frames_of(folder, most)
    for frame, pose in pairs:
        stripe = tracker.step(frame, pose).stripe
        assert stripe is not None, f"frame {frame.index} shows no stripe"
        width_px = width_of(tracker)
        image = frame.image_dn if along_rows else np.ascontiguousarray(frame.image_dn.T)
        centres["ours"].append(stripe.position_px)
        own_px.append(stripe.sigma_px)
        beside_px.append(stripe.beside_px)
        for name, (read, share, _) in PEERS.items():
            centres[name].append(read(image, share * width_px))
        widths.append(width_px)
        places.append(pose.T_base_tool)
    stack = {name: np.array(lines) for name, lines in centres.items()}
    width_px = float(np.median(widths))
    middle = consensus(stack)
    lit = np.flatnonzero(np.isfinite(stack["ours"]).mean(axis=0) > 0.5)
    lines = slice(int(lit[0]), int(lit[-1]) + 1)
    moved = [np.abs(a - b).max() > STILL_MM for a, b in itertools.pairwise(places)]
    print(f"\n{folder.name}: {len(pairs)} frames, sigma {width_px:.1f} px, {lines.stop - lines.start} lines")
    ours, own, beside = (np.array(values)[:, lines] for values in (centres["ours"], own_px, beside_px))
    apart = math.ceil(APART_SIGMAS * width_px)
    alone = pull(ours, own**2, apart)
    together = pull(means(ours), means(beside**2) / MEAN_LINES, math.ceil(apart / MEAN_LINES))
    print(f"ours over its stated sigma: lines {alone:.2f}, means over {MEAN_LINES} {together:.2f}")
    print(f"{'':20} {'held':>6} {'gross':>7} {'along':>8} {'still':>8}")
    for name, centre in stack.items():
        own = PEERS[name][2] if name in PEERS else 0.0
        held = np.isfinite(centre[:, lines])
        gross = np.abs(centre - middle)[:, lines][held] > GROSS_SIGMAS * width_px
        smooth = smoothed(
            np.where(np.abs(centre - middle) <= GROSS_SIGMAS * width_px, centre, np.nan),
            width_px * math.sqrt(max(1.0 - own * own, 0.0)),
        )[:, lines]
        bend = (smooth[:, : -2 * apart] - 2.0 * smooth[:, apart:-apart] + smooth[:, 2 * apart :]) / math.sqrt(
            6.0
        )
        steps = np.diff(smooth, axis=0)[~np.array(moved)]
        still = float(np.nanmedian(np.nanstd(steps, axis=0))) / math.sqrt(2.0) if len(steps) > 1 else math.nan
        print(
            f"{name:20} {100 * held.mean():5.1f}% {100 * gross.mean():6.2f}% "
            f"{1.4826 * float(np.nanmedian(np.abs(bend))):8.3f} {still:8.3f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", type=Path, nargs="+", help="folders of recordings")
    parser.add_argument("--frames", type=int, default=20, help="the last so many frames of each")
    options = parser.parse_args()
    for folder in options.recordings:
        tell(folder, options.frames)


if __name__ == "__main__":
    main()
