"""A quantity of a check: measured, expected, sigma, and what follows."""

import math
from dataclasses import dataclass
from enum import Enum

MAX_SIGMAS = 3.0
"""Largest deviation of a measured quantity from the expected one, sigmas."""


class SetupVerdict(Enum):
    """Verdict of a measured quantity on the setup."""

    OK = "ok"
    NOT_EXPLAINED = "does not explain"
    UNTOLD = "cannot tell"


class LightStage(Enum):
    """The part of a setup that a quantity is about, in the order in which light passes them backwards."""

    SENSOR = "sensor"
    PLACE = "camera, laser, hand-eye"
    STRIPE = "stripe"
    ARC = "arc"


@dataclass(frozen=True)
class Measure:
    """A quantity: `measured` and `expected` with the 1 sigma of their difference, in a unit.

    `text` says what was measured where a number alone does not. `cure` says what to do where the setup does
    not explain it.
    """

    stage: LightStage
    name: str
    measured: float
    expected: float
    sigma: float
    unit: str
    verdict: SetupVerdict
    cure: str = ""
    text: str = ""

    @property
    def shown(self) -> tuple[str, str, str]:
        """Measured, expected and sigma as a table shows them, nothing for what is not known."""
        if self.text:
            return self.text, "", ""
        return _number(self.measured), _number(self.expected), _number(self.sigma)


def _number(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else ""


def judged(
    stage: LightStage, name: str, measured: float, expected: float, sigma: float, unit: str, cure: str
) -> Measure:
    """Return a quantity with its verdict: undetermined where it, or the sigma, is unknown."""
    off_sigmas = abs(measured - expected) / sigma if sigma > 0.0 else math.nan
    if math.isnan(off_sigmas):
        verdict = SetupVerdict.UNTOLD
    else:
        verdict = SetupVerdict.NOT_EXPLAINED if off_sigmas > MAX_SIGMAS else SetupVerdict.OK
    return Measure(
        stage=stage,
        name=name,
        measured=measured,
        expected=expected,
        sigma=sigma,
        unit=unit,
        verdict=verdict,
        cure=cure,
    )
