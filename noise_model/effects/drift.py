"""How an output drifts over a recording: at a rate at first, and to rest."""

from __future__ import annotations

import math

from noise_model.effects.effect import Values
from noise_model.fit import Parameter

LIMIT_LN = 4.0
"""A drift's logarithm is held here: no source gets fifty times as bright or as dim while it settles."""

EQUATION = "exp(rate_per_s settle_s (1 - exp(-t / settle_s))), t since the first frame"

PARAMETERS = (
    Parameter("rate_per_s", "1/s", 0.0, 0.1, -1.0, 1.0, 0.001),
    Parameter("settle_s", "s", 30.0, 30.0, 0.2, 1000.0, 0.1),
)


def settling(values: Values, timestamp_s: float) -> float:
    """Return the factor by which an output has drifted at a time since the first frame: 1 at 0 s.

    exp(rate settle (1 - exp(-t / settle))): it starts at `rate_per_s` and comes to rest over `settle_s`, as
    what warms up does. The logarithm is held at `LIMIT_LN`.
    """
    ln = values["rate_per_s"] * values["settle_s"] * -math.expm1(-timestamp_s / values["settle_s"])
    return math.exp(min(max(ln, -LIMIT_LN), LIMIT_LN))
