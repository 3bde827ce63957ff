"""What others need for the stripe alone, on latency.py's cases: the time of a frame, and at equal error.

A method that averages the centres of n frames has less noise and the same bias. The time at equal error is
that of as many frames as it takes until its centres are as near to the truth as the tracker's in each frame.
The tracker's lines that use their neighbours are held against the other method's means along the stripe.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from latency_cases import BOTH_ON, Case, speckled
from latency_worker import CURRENT_A, EXPOSURE_S, PERIOD_S

from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64, Integers
from noise_model.forward import Renderer, draw_frame
from tracker.geometry import TRACK_REACH_MM, SensorGeometry
from tracker.state import Frame, Pose
from tracker.stripe.band import FIT_SIGMAS
from tracker.stripe.expected import ExpectedStripe, expect_stripe
from tracker.stripe.smooth import smoothed
from tracker.tracker import Tracker
from validation.bench.stripe_peers import PEERS, steger

FRAMES = 64
"""So many frames of one pose are read, and averaged at most."""

NEIGHBOURS, GROSS_PX = 31, 2.0
"""Means along the stripe are of so many lines, without those that are so far off their median.

The tracker draws its lines through 32 at most. Lines off corners are no nearer to a corner than half of it.
"""

RUNS = 5
"""How often each method is timed on a picture."""

STRAIGHT_SIGMAS, BEND_PX = 4.0, 0.05
"""A line is off the corners if the trace bends by no more than this within so many of the stripe's sigmas."""


@dataclass(frozen=True)
class Read:
    """Frames of one pose, their stripe's true centre (W,), px, and which lines (W,) are off corners."""

    frames: list[Frame]
    expected: ExpectedStripe
    center_px: Float64
    off_corners: np.ndarray
    half_depth_px: int

    @classmethod
    def of(cls, case: Case) -> Read:
        """Draw the frames at a level pose."""
        setup, rng, renderer = case.setup, np.random.default_rng(1), Renderer()
        drawn, geometry = speckled(setup), SensorGeometry.of(setup)
        expected = expect_stripe(geometry, make_scene(setup, np.eye(4)))
        assert expected is not None
        frames = [
            Frame(
                n,
                PERIOD_S * n,
                draw_frame(drawn, np.eye(4), BOTH_ON, rng, renderer=renderer),
                EXPOSURE_S,
                CURRENT_A,
            )
            for n in range(FRAMES)
        ]
        sigma_px = float(expected.sigma_px.max())
        bends = np.abs(np.gradient(np.gradient(expected.position_px))) > BEND_PX
        reach = max(math.ceil(STRAIGHT_SIGMAS * sigma_px), NEIGHBOURS // 2)
        off_corners = (np.convolve(bends, np.ones(2 * reach + 1), "same") == 0.0) & expected.shown
        half_depth = math.ceil(geometry.reach_px(TRACK_REACH_MM) + FIT_SIGMAS * sigma_px)
        return cls(frames, expected, expected.position_px + expected.bias_px, off_corners, half_depth)

    @property
    def width_px(self) -> float:
        """The stripe's 1 sigma, px."""
        return float(np.median(self.expected.sigma_px))

    def band(self, image: Integers) -> Integers:
        """Return the pixels about the expected stripe (depth, W), as many as a step in track mode reads."""
        rows = np.rint(self.expected.position_px).astype(int)
        reach = np.arange(-self.half_depth_px, self.half_depth_px + 1)[:, None]
        rows = np.clip(rows + reach, 0, len(image) - 1)
        return np.ascontiguousarray(image[rows, np.arange(image.shape[1])])

    def rows(self) -> tuple[int, int]:
        """Return the first and the last row but one that the stripe may be in."""
        position = self.expected.position_px[self.expected.shown]
        first = math.floor(position.min()) - self.half_depth_px
        return max(first, 0), math.ceil(position.max()) + self.half_depth_px

    def errors_px(self, position_px: Float64) -> Float64:
        """Return the errors (n, lines off corners) of centres (n, W)."""
        return np.asarray((position_px - self.center_px)[:, self.off_corners])


def spread_px(errors_px: Float64, n: int) -> float:
    """Return the 1 sigma of the means of n frames' errors (frames, lines), px, their bias included.

    It is 1.4826 times the median of their sizes: gross ones and lines that are not read are forgiven.
    """
    groups = errors_px[: len(errors_px) // n * n].reshape(-1, n, errors_px.shape[1])
    return 1.4826 * float(np.nanmedian(np.abs(groups.mean(axis=1))))


def frames_for(errors_px: Float64, wanted_px: float) -> int | None:
    """Return how many frames have to be averaged for an error, None if all of them do not do."""
    enough = (n for n in range(1, len(errors_px) + 1) if spread_px(errors_px, n) <= wanted_px)
    return next(enough, None)


def along_the_stripe(position_px: Float64) -> Float64:
    """Return the mean of each line's centre (n, W) and its neighbours', gross ones left out."""
    reach = NEIGHBOURS // 2
    padded = np.pad(position_px, ((0, 0), (reach, reach)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, NEIGHBOURS, axis=1)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "(Mean of empty|All-NaN) slice", RuntimeWarning)
        off_px = np.abs(windows - np.nanmedian(windows, axis=2, keepdims=True))
        return np.asarray(np.nanmean(np.where(off_px > GROSS_PX, np.nan, windows), axis=2))


def ours(case: Case, read: Read) -> tuple[Float64, Float64]:
    """Return the tracker's centres (n, W), px: of each line alone, and smoothed with its neighbours."""
    tracker, pose = Tracker(case.setup), Pose(np.eye(4))
    for frame in read.frames[:8]:
        tracker.step(frame, pose)
    stripes = [stripe for frame in read.frames if (stripe := tracker.step(frame, pose).stripe) is not None]
    return np.array([s.position_px for s in stripes]), np.array([smoothed(s).position_px for s in stripes])


def cpu_ms(run: Callable[..., Any], *arguments: Any) -> float:
    """Return the median CPU time of a call, ms; the first, which fetches its code, is not counted."""
    took = np.empty(RUNS + 1)
    for n in range(RUNS + 1):
        began_s = time.thread_time()
        run(*arguments)
        took[n] = time.thread_time() - began_s
    return 1e3 * float(np.median(took[1:]))


def print_peers(cases: list[Case], track_ms: dict[str, float], search_ms: dict[str, float]) -> None:
    """Print what others take for the stripe alone, and what Steger's method takes for our error."""
    print(
        "\nOthers, the stripe alone: CPU ms a frame back to back, over ours for the whole step (median CPU)"
    )
    print(f"{'':16} {'':10} {'frame':>8} {'over search':>11} {'band':>8} {'over track':>10}")
    reads = {}
    for case in cases:
        read = reads[case.name] = Read.of(case)
        image = read.frames[0].image_dn
        for name, peer in PEERS.items():
            frame_ms, band_ms = (cpu_ms(peer, pixels, read.width_px) for pixels in (image, read.band(image)))
            print(
                f"{case.name:16} {name:10} {frame_ms:8.1f} {frame_ms / search_ms[case.name]:11.1f}"
                f" {band_ms:8.1f} {band_ms / track_ms[case.name]:10.1f}",
                flush=True,
            )
    print("\nSteger at equal error: 1 sigma of centres off corners about the truth, px; gross ones forgiven")
    print(
        f"{'':16} {'Steger':>8} {'of ' + str(FRAMES):>8}   {'ours':12} {'px':>8} {'frames':>8}"
        f" {'ms, band':>8} {'over track':>10}"
    )
    for case in cases:
        read = reads[case.name]
        first, end = read.rows()
        steger_px = np.array(
            [first + steger(frame.image_dn[first:end], read.width_px) for frame in read.frames]
        )
        band_ms = cpu_ms(steger, read.band(read.frames[0].image_dn), read.width_px)
        alone, smooth = ours(case, read)
        for kind, position_px, theirs_px in (
            ("a line alone", alone, steger_px),
            ("neighbours", smooth, along_the_stripe(steger_px)),
        ):
            own_px, errors = spread_px(read.errors_px(position_px), 1), read.errors_px(theirs_px)
            n = frames_for(errors, own_px)
            needed = f"{'> ' + str(FRAMES):>8} {'':8} {'':10}"
            if n is not None:
                needed = f"{n:8} {n * band_ms:8.1f} {n * band_ms / track_ms[case.name]:10.1f}"
            print(
                f"{case.name:16} {spread_px(errors, 1):8.3f} {spread_px(errors, FRAMES):8.3f}   {kind:12}"
                f" {own_px:8.3f} {needed}",
                flush=True,
            )
