"""Result of every calibration, and its progress."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from arctrack.calibrate.page import CalibrationPage
from arctrack.recording import BadFrame, CalibrationValues

Tell = Callable[[int, int], None]
"""Callback with the amount done and its total."""

Steps = Callable[[str, str], Tell]
"""Callback that begins a step, with the activity and the unit counted; it returns the step's progress
callback.
"""

Warn = Callable[[Iterable[str]], None]
"""Callback with warnings for the user, a line each."""

Result = TypeVar("Result")


@dataclass(frozen=True)
class CalibrationStage(Generic[Result]):
    """Completed calibration: result, page, and values for a setup.

    `refusal` is why the values must stay out; `bad_frames` are those of a recording that could not be read.
    """

    result: Result
    page: CalibrationPage
    records: tuple[CalibrationValues, ...]
    refusal: str | None = None
    bad_frames: Sequence[BadFrame] = ()


def left_out(reasons: Mapping[str, str]) -> Iterator[str]:
    """Yield a line on each unused input, with the reason."""
    return (f"{name}: left out: {reason}" for name, reason in reasons.items())
