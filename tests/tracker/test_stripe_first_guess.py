"""Scan lines' pixels in their lanes, and what is known of each before its fit, against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from noise_model.compiled.arrays import Bool, Float32
from noise_model.compiled.kernel import kernel
from noise_model.compiled.lanes import N_LANES, load, store
from tracker.stripe.line_fit.block import CORRELATION_PX, MIN_SIGMA_E, WINDOW_SIGMAS
from tracker.stripe.line_fit.first_guess import (
    CORE_MEAN,
    CORE_SIGMAS,
    MAX_PIXELS,
    PAD,
    PixelVariance,
    Rows,
    Window,
    core_of,
    first_guess,
    leave_out,
    take_line,
    write_block,
)
from tracker.stripe.line_fit.normal_equations import BEYOND, COUNTS, HIDDEN, Block

seeds = st.integers(0, 2**32 - 1)


@kernel
def block_of(
    charge: Float32, background: Float32, censored: Bool, n: Float32, rows: Rows, block: Block
) -> None:
    """Write sixteen lines of some pixels each (n,) into a block."""
    longest = charge.shape[1]
    for lane in range(N_LANES):
        own = int(n[lane])
        take_line(charge[lane, :own], background[lane, :own], censored[lane, :own], lane, rows)
        leave_out(lane, own, rows.charge.shape[1], rows)
    write_block(rows, longest, block)


@kernel
def guess_of(block: Block, n: int, asked: Float32, map_rel: float, base_e: float, out: Float32) -> None:
    windows = Window(
        load(asked[0], 0),
        load(asked[1], 0),
        load(asked[2], 0),
        load(asked[3], 0),
        load(asked[4], 0),
        load(asked[5], 0),
        load(asked[5], 0),
        load(asked[5], 0),
    )
    known = first_guess(block, n, windows, PixelVariance(1.0, 0.0, map_rel, base_e))
    for k in range(len(known)):
        store(out[k], 0, known[k])


@settings(deadline=None, max_examples=20)
@given(seeds, st.integers(8, 60), st.sampled_from([(0.05, 24.0), (0.0, 0.0)]))
def test_each_line_is_in_its_lane_and_guessed_as_its_twin(
    seed: int, longest: int, noise: tuple[float, float]
) -> None:
    rng = np.random.default_rng(seed)
    charge, background = rng.uniform(-100.0, 9e3, (2, N_LANES, longest)).astype(np.float32)
    n, censored = rng.integers(5, longest + 1, N_LANES), rng.random(charge.shape) < 0.1
    width, place = rng.uniform(0.5, 9.0, N_LANES), rng.uniform(0.0, n - 1.0)
    cores = [core_of(*line) for line in zip(place, width, n, strict=True)]
    edge = rng.choice([0.0, 300.0], N_LANES)
    asked = np.array([place, n, width, *np.transpose(cores), edge], np.float32)
    rows = Rows(*np.empty((3, N_LANES, MAX_PIXELS + PAD), np.float32))
    block = Block(*np.full((3, rows.charge.size), np.nan, np.float32))
    block_of(charge, background, censored, asked[1], rows, block)
    known = np.empty((7, N_LANES), np.float32)
    guess_of(block, longest, asked, *noise, known)

    is_held = np.arange(longest) < n[:, None]
    for written, values in zip(block[:2], (charge, background), strict=True):
        lines = written.reshape(-1, N_LANES)[:longest].T
        np.testing.assert_array_equal(lines, np.where(is_held, values, 0.0))
    kinds = np.where(is_held, np.where(censored, HIDDEN, COUNTS), BEYOND)
    np.testing.assert_array_equal(block.kind.reshape(-1, N_LANES)[:longest].T, kinds)
    for lane in range(N_LANES):
        own, near = slice(n[lane]), np.abs(np.arange(n[lane]) - round(place[lane]))
        core = near <= int(CORE_SIGMAS * width[lane]) + 1
        level = background[lane, own].mean(dtype=float)
        over = (charge - background)[lane, own][core].mean(dtype=float) / CORE_MEAN
        smooth = max(np.hypot(noise[0] * level, noise[1]), MIN_SIGMA_E)
        twin = [
            *asked[:3, lane],
            max(over, 1.0),
            level,
            np.hypot(smooth, edge[lane]) ** -2,
            np.hypot(smooth / CORRELATION_PX, edge[lane] / (WINDOW_SIGMAS * width[lane])) ** -2,
        ]
        # Charge and background may nearly cancel each other.
        assert known[3, lane] == pytest.approx(twin.pop(3), rel=1e-4, abs=1e-2)
        assert np.delete(known[:, lane], 3) == pytest.approx(twin, rel=1e-4)
