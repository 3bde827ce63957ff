"""Drift of an output over a recording: at a rate at first and to rest, and to and fro."""

from __future__ import annotations

import math

from noise_model.effects.effect import Values
from noise_model.fit import Parameter

LIMIT_LN = 4.0
"""A drift's logarithm is held here: no source gets fifty times as bright or as dim while it drifts."""

EQUATION = (
    "exp(rate_per_s settle_s (1 - exp(-t / settle_s)) + swing_sin sin(2 pi swing_hz t) "
    "+ swing_cos cos(2 pi swing_hz t)), t since the first frame"
)

PARAMETERS = (
    Parameter("rate_per_s", "1/s", 0.0, 0.1, -1.0, 1.0, 0.001),
    Parameter("settle_s", "s", 30.0, 30.0, 0.2, 1000.0, 0.1),
    Parameter("swing_sin", "", 0.0, 0.1, -1.0, 1.0, 0.002),
    Parameter("swing_cos", "", 0.0, 0.1, -1.0, 1.0, 0.002),
    Parameter("swing_hz", "Hz", 1.0, 1.0, 0.05, 10.0, 0.005),
)


def drifted(values: Values, timestamp_s: float) -> float:
    """Return the factor by which an output has drifted at a time since the first frame, see `EQUATION`.

    It starts at `rate_per_s` and comes to rest over `settle_s`, as what warms up does; and it swings, as what
    a controller holds or mains feed does. The logarithm is held at `LIMIT_LN`.
    """
    turn = 2.0 * math.pi * values["swing_hz"] * timestamp_s
    ln = values["rate_per_s"] * values["settle_s"] * -math.expm1(-timestamp_s / values["settle_s"])
    ln += values["swing_sin"] * math.sin(turn) + values["swing_cos"] * math.cos(turn)
    return math.exp(min(max(ln, -LIMIT_LN), LIMIT_LN))
