"""The median of some hundred numbers, for Python without NumPy's overhead, and for kernels.

NumPy's takes some 20 µs a call, most of it Python's. numba's sorts in part, 7 µs for 640 numbers; counting
sixteen float32 at once takes 0.5 µs. A tracker's step asks for some hundred medians.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from noise_model.compiled.arrays import Float32, Float64
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.compiled.lanes import N_LANES, bits_of, float_of, least, load, spread, total, where
from noise_model.compiled.ordering import stable_order


def median(values: npt.ArrayLike) -> float:
    """Return the median of values (n,), as `numpy.median` does; NaN where one is NaN, or without any."""
    # A copy of its own has one type, whatever the values' strides: nothing is compiled a second time.
    return float(exact_median(np.array(values, np.float64)))


def known_median(values: npt.ArrayLike) -> float:
    """Return the median of the values (n,) that are no NaN, as `numpy.nanmedian` does; NaN without any."""
    held = np.array(values, np.float64)
    return float(exact_median(held[~np.isnan(held)]))


BLOCK = 4 * N_LANES
"""Number of values that are counted at a time: four sums that do not wait for each other."""


@kernel
def numbers_for(n: int) -> int:
    """Return how long an array of n numbers must be for `median_of`."""
    return -(-n // BLOCK) * BLOCK


@kernel
def _in_order(key: int) -> float:
    """Return the float32 that stands at a place in the order of all."""
    bits = np.int32(key)
    value: float = float_of(bits if bits >= np.int32(0) else bits ^ np.int32(0x7FFFFFFF))
    return value


@kernel
def _place(value: float) -> int:
    """Return the place of a float32 in the order of all."""
    bits = bits_of(np.float32(value))
    return int(bits if bits >= np.int32(0) else bits ^ np.int32(0x7FFFFFFF))


@kernel
def _count_up_to(values: Float32, max_value: float) -> float:
    """Return the number of values (n,), n a multiple of BLOCK, that are not above a limit."""
    limit, zero, unity = spread(max_value), spread(0.0), spread(1.0)
    a, b, c, d = zero, zero, zero, zero
    for i in range(0, values.shape[0], BLOCK):
        a += where(load(values, i) <= limit, unity, zero)
        b += where(load(values, i + N_LANES) <= limit, unity, zero)
        c += where(load(values, i + 2 * N_LANES) <= limit, unity, zero)
        d += where(load(values, i + 3 * N_LANES) <= limit, unity, zero)
    count: float = total((a + b) + (c + d))
    return count


@kernel
def _least_above(values: Float32, limit: float) -> float:
    """Return the least of values (n,), n a multiple of BLOCK, above a limit; inf for none."""
    bound, nothing = spread(limit), spread(math.inf)
    lowest = nothing
    for i in range(0, values.shape[0], N_LANES):
        value = load(values, i)
        value = where(value > bound, value, nothing)
        lowest = where(value < lowest, value, lowest)
    lowest_value: float = least(lowest)
    return lowest_value


@kernel
def _greatest_up_to(values: Float32, limit: float) -> float:
    """Return the greatest of values (n,), n a multiple of BLOCK, that is not above a limit; -inf for none."""
    bound, nothing = spread(limit), spread(-math.inf)
    highest = nothing
    for i in range(0, values.shape[0], N_LANES):
        value = load(values, i)
        value = where(value <= bound, value, nothing)
        highest = where(value > highest, value, highest)
    lowest_below_0: float = least(spread(0.0) - highest)
    return -lowest_below_0


@kernel
def _of_rank(values: Float32, n: int, rank: int) -> float:
    """Return the value of a rank among the first n, none of them NaN, from 1 on in rising order.

    `values` (`numbers_for(n)`,) or longer are written over behind them. All float32 stand in the order of
    their bits, so the value that has so many up to itself is found by halving, exactly, without sorting.
    Mostly a limit soon has so many below, and the value is the greatest of these.
    """
    end = numbers_for(n)
    for i in range(n, end):
        values[i] = np.float32(math.inf)
    held, low, high = values[:end], _place(-math.inf), _place(math.inf)
    while low < high:
        middle = (low + high) // 2
        count = _count_up_to(held, _in_order(middle))
        if count == rank:
            low = high = _place(_greatest_up_to(held, _in_order(middle)))
        elif count > rank:
            high = middle
        else:
            low = middle + 1
    return _in_order(low)


@kernel
def median_of(values: Float32, n: int) -> float:
    """Return the median of the first n values, none of them NaN; NaN for n = 0.

    `values` (`numbers_for(n)`,) or longer are written over behind them.
    """
    if n == 0:
        return math.nan
    half = (n + 1) // 2
    lower = _of_rank(values, n, half)
    held = values[: numbers_for(n)]
    if n % 2 == 1 or _count_up_to(held, lower) > half:
        return np.float64(lower)
    return 0.5 * (np.float64(lower) + np.float64(_least_above(held, lower)))


@kernel(allocates=True)
def exact_median(values: Float64) -> float:
    """Return the `median` of values (n,).

    Rounding to float32 keeps their order. So the middle ones are among those that round to the middle of the
    rounded: mostly a single value.
    """
    n = values.shape[0]
    for value in values:
        if math.isnan(value):
            return math.nan
    if n == 0:
        return math.nan
    rounded, ties = np.empty(numbers_for(n), np.float32), np.empty(n)
    for i in range(n):
        rounded[i] = values[i]
    half = (n + 1) // 2
    middle, n_ties = _of_rank(rounded, n, half), 0
    for i in range(n):
        if rounded[i] == middle:
            ties[n_ties] = values[i]
            n_ties += 1
    held, order = rounded[: numbers_for(n)], stable_order(ties[:n_ties])
    below = min(int(_count_up_to(held, middle)), n) - n_ties
    rank = half - 1 - below
    if n % 2 == 1:
        return float(ties[order[rank]])
    if rank + 1 < n_ties:
        return float(0.5 * (ties[order[rank]] + ties[order[rank + 1]]))
    next_above, upper = _least_above(held, middle), math.inf
    for i in range(n):
        if rounded[i] == next_above:
            upper = min(upper, values[i])
    return float(0.5 * (ties[order[rank]] + upper))


@kernel(fastmath=REDUCTION)
def _are_finite(values: Float32) -> bool:
    """Return True if all values (n,) are finite: 0 times one that is not is NaN."""
    nothing = np.float32(0.0)
    for i in range(values.shape[0]):
        nothing += np.float32(0.0) * values[i]
    return not math.isnan(nothing)


@kernel
def close_up(room: Float32, n: int) -> int:
    """Move those of the first n numbers that are finite to the front; return how many they are."""
    if _are_finite(room[:n]):
        return n
    count = 0
    for i in range(n):
        if math.isfinite(room[i]):
            room[count] = room[i]
            count += 1
    return count


@kernel
def keep_finite(values: Float64 | Float32, room: Float32) -> int:
    """Write those of values (n,) that are finite, as float32, into `room`; return how many they are.

    Mostly all are: they are written together.
    """
    for i in range(values.shape[0]):
        room[i] = values[i]
    return close_up(room, values.shape[0])


@kernel
def finite_median(values: Float64, room: Float32) -> float:
    """Return the median of the values (n,) that are finite, as float32; NaN without any.

    `room` (`numbers_for(n)`,) or longer is written over.
    """
    return median_of(room, keep_finite(values, room))
