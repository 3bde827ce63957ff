"""A robot that follows held commands late, by a recursive filter on a grid of 0.1 ms."""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import lfilter

STEP_S = 1e-4


def follow(commanded, times_s, dead_time_s, time_constant_s):
    """Return where a robot is at some times (n,) after a dead time and a first-order lag, from rest."""
    first_s, values_mm = commanded.times_s[0], commanded.values_mm
    grid_s = first_s + STEP_S * np.arange(round((max(times_s) - first_s) / STEP_S) + 2)
    held_mm = values_mm[np.searchsorted(commanded.times_s, grid_s + 1e-9, side="right") - 1]
    fade = math.exp(-STEP_S / time_constant_s)
    moved_mm = lfilter([0.0, 1.0 - fade], [1.0, -fade], held_mm - values_mm[0]) + values_mm[0]
    return np.interp(times_s - dead_time_s, grid_s, moved_mm)
