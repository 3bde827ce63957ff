"""Result of every calibration, and its progress."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from arctrack.calibrate.page import CalibrationPage
from arctrack.recording import CalibrationValues

Tell = Callable[[int, int], None]
"""Is told how much is done, and of how much."""

Steps = Callable[[str, str], Tell]
"""Begins a step, by what is done and what is counted; what it returns is told how far the step is."""

Warn = Callable[[Iterable[str]], None]
"""Is told at once what a user should know, a line each."""

Result = TypeVar("Result")


@dataclass(frozen=True)
class CalibrationStage(Generic[Result]):
    """Completed calibration: result, page, and values for a setup; `refusal` is why these must stay out."""

    result: Result
    page: CalibrationPage
    records: tuple[CalibrationValues, ...]
    refusal: str | None = None


def left_out(reasons: Mapping[str, str]) -> Iterator[str]:
    """Yield a line on each unused input, with the reason."""
    return (f"{name}: left out: {reason}" for name, reason in reasons.items())
