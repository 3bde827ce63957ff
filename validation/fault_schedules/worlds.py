"""A cell's world at random: its seam, its motion and its robot."""

from __future__ import annotations

import numpy as np

from arctrack.simulation.cell.world import World

MIN_SPEED_MM_S = 4.0
"""The slowest travel that is drawn, mm/s."""


def draw_world(rng: np.random.Generator) -> World:
    """Return a world at random."""
    side = float(rng.choice((-1.0, 1.0)))
    return World(
        start_base_mm=(rng.uniform(-100.0, 100.0), side * rng.uniform(20.0, 200.0), rng.uniform(-20.0, 20.0)),
        speed_mm_s=rng.uniform(MIN_SPEED_MM_S, 12.0),
        weave_mm=rng.uniform(0.8, 2.5),
        weave_hz=rng.uniform(1.0, 3.0),
        turned_deg=(rng.uniform(-8.0, 8.0), rng.uniform(4.0, 15.0), rng.uniform(-10.0, 10.0)),
        displaced_mm=(rng.uniform(-3.0, 3.0), rng.uniform(-1.0, 1.0)),
        slope=(rng.uniform(-0.02, 0.02), rng.uniform(-0.01, 0.01)),
        bend_mm=rng.uniform(0.0, 0.4),
        bend_length_mm=rng.uniform(150.0, 400.0),
        latency_s=rng.uniform(0.02, 0.12),
        time_constant_s=rng.uniform(0.03, 0.15),
    )
