"""The place where columns of a profile change from one face to another, by what they show and what they miss.

A column shows the face that it lies on, or misses it: by a dropout, a false echo, a rim that lies off both.
Columns miss in runs, so each face is a Markov chain of two states with rates of its own, and an edge is where
the rates and the heights change (Gilbert 1960, Bell System Technical Journal 39, 1253). The rates are
integrated out with Jeffreys' prior (Krichevsky and Trofimov 1981, IEEE Transactions on Information Theory 27,
199). So between the last column that shows the one face and the first that shows the other all places are as
likely where both miss alike. A face that misses nothing ends where it is last seen. Columns that the edge
hides miss for sure, and what lies behind them begins anew.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float64
from noise_model.compiled.kernel import kernel
from tracker.joint.measured import OFF_SIGMAS

STEPS = 4
"""Places within a column at which the edge is tried."""

WIDTH_SIGMAS = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""The widths of a hidden strip that are tried, in its sigmas."""


class FaceChange(NamedTuple):
    """The place at which columns change faces, mm, and its variance, mm^2."""

    y_mm: float
    variance_mm2: float


class Columns(NamedTuple):
    """Columns (n,) about an edge: whether each shows a face, and where it meets that before and that behind.

    `off_before` and `off_behind` are the squares, in sigmas, by which what it shows lies off either. Places
    are in mm, the columns `pitch_mm` apart.
    """

    seen: Bool
    before_mm: Float64
    behind_mm: Float64
    off_before: Float64
    off_behind: Float64
    pitch_mm: float


@kernel
def transition_nats(counts: Float64, was_seen: bool, is_seen: bool) -> float:
    """Count the transition from a column to the next one, and return its likelihood, nats.

    It is the one that `counts` (2, 2), of what was seen by what is, give it before: of n from the same state
    a of them its like (a + 1/2) / (n + 1), the chain's rates being integrated out.
    """
    was, now = int(was_seen), int(is_seen)
    nats = math.log((counts[was, now] + 0.5) / (counts[was, 0] + counts[was, 1] + 1.0))
    counts[was, now] += 1.0
    return nats


@kernel(allocates=True)
def change_of_faces(columns: Columns, hidden_mm: float, hidden_sigma_mm: float) -> FaceChange:
    """Return the place at which columns change from the face before to the one behind.

    The edge hides so much of the face behind next to it, to a 1 sigma. A place is not known better than
    within a column, over which a height is taken.
    """
    seen, n = columns.seen, columns.seen.shape[0]
    # Of the first k columns: their cost before, and how many show a face; of those from k on: their cost.
    costs, shown, ln_before = np.zeros(n + 1), np.zeros(n + 1), np.zeros(n + 1)
    behind, ln_behind, ln_anew = np.zeros(n + 1), np.zeros(n + 1), np.zeros(n + 1)
    counts = np.zeros((2, 2))
    for k in range(n):
        costs[k + 1] = costs[k] + (columns.off_before[k] if seen[k] else 0.0)
        shown[k + 1] = shown[k] + (1.0 if seen[k] else 0.0)
        ln_before[k + 1] = ln_before[k] + (transition_nats(counts, seen[k - 1], seen[k]) if k > 0 else 0.0)
    counts[:] = 0.0
    for k in range(n - 1, 0, -1):
        behind[k] = behind[k + 1] + (columns.off_behind[k] if seen[k] else 0.0)
        n_seen = shown[n] - shown[k]
        share = (n_seen if seen[k] else n - k - n_seen) + 0.5
        ln_anew[k] = ln_behind[k + 1] + math.log(share / (n - k + 1.0))
        ln_behind[k] = ln_behind[k + 1] + transition_nats(counts, seen[k - 1], seen[k])
    n_widths = len(WIDTH_SIGMAS) if hidden_sigma_mm > 0.0 else 1
    step_mm, start_mm = columns.pitch_mm / STEPS, columns.before_mm[0]
    n_steps = max(int((columns.before_mm[n - 1] - start_mm) / step_mm), 1)
    logs, highest = np.empty((n_widths, n_steps)), -math.inf
    for width in range(n_widths):
        off = WIDTH_SIGMAS[width] if n_widths > 1 else 0.0
        width_mm, k, first = max(hidden_mm + off * hidden_sigma_mm, 0.0), 1, 1
        for step in range(n_steps):
            place_mm = start_mm + (step + 0.5) * step_mm
            while k < n and columns.before_mm[k] <= place_mm:
                k += 1
            while first < n and (first < k or columns.behind_mm[first] <= place_mm + width_mm):
                first += 1
            among_hidden = OFF_SIGMAS * OFF_SIGMAS * (shown[first] - shown[k])
            after = ln_behind[first] if first == k else ln_anew[first]
            chi2 = costs[k] + behind[first] + among_hidden + off * off
            logs[width, step] = ln_before[k] + after - 0.5 * chi2
            highest = max(highest, logs[width, step])
    total, mean, square = 0.0, 0.0, 0.0
    for step in range(n_steps):
        weight, place_mm = 0.0, (step + 0.5) * step_mm
        for width in range(n_widths):
            weight += math.exp(logs[width, step] - highest)
        total += weight
        mean += weight * place_mm
        square += weight * place_mm * place_mm
    mean /= total
    return FaceChange(start_mm + mean, max(square / total - mean * mean, columns.pitch_mm**2 / 12.0))


@kernel
def fill_places(y_mm: Float64) -> None:
    """Write the places (n,) of columns that hold none, between those of columns that do; the ends do."""
    last = 0
    for k in range(1, y_mm.shape[0]):
        if math.isnan(y_mm[k]):
            continue
        for i in range(last + 1, k):
            y_mm[i] = y_mm[last] + (y_mm[k] - y_mm[last]) * (i - last) / (k - last)
        last = k
