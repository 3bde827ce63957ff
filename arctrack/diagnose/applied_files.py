"""Files for programs of effects that were added to a setup: applied.json and applied.npz."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arctrack.diagnose.diagnosis_files import (
    ADDED_JSON,
    ADDED_NPZ,
    DIGITS,
    gap_numbers,
    named_effect,
    plain,
    write_json,
    write_predictions,
)
from noise_model.setup import Setup
from sim_to_real.diagnosis import Gap, HeldOutPrediction, NamedEffect


@dataclass(frozen=True, eq=False)
class AppliedEffects:
    """The gap of held-out frames before and after effects were added to their setup.

    The effects were fitted to the recording `fitted_on`. The frames are of the recording `on`: the same, of
    which other frames were fitted, or, if it `is_other`, one that no fit of the effects has seen. `n_fitted`
    of its frames gave the nuisances.
    """

    effects: tuple[NamedEffect, ...]
    fitted_on: str
    on: str
    setup: Setup
    gap: Gap
    predicted: HeldOutPrediction
    n_fitted: int
    is_other: bool
    folder: Path


def write_applied_numbers(applied: AppliedEffects) -> None:
    """Write applied.npz and applied.json; ArctrackError if one cannot be written."""
    write_predictions(applied.predicted, applied.folder / ADDED_NPZ)
    write_json(content(applied), applied.folder / ADDED_JSON)


def content(applied: AppliedEffects) -> dict[str, Any]:
    """Return the content of applied.json; what is not known is null."""
    rounded: dict[str, Any] = plain(
        {
            "format": "arctrack-applied/1",
            "effects": [named_effect(effect) for effect in applied.effects],
            "fitted_on": applied.fitted_on,
            "predicted_on": applied.on,
            "frames": {"held_out": len(applied.predicted.frames), "nuisances_fitted": applied.n_fitted},
            "gap": gap_numbers(applied.gap),
            "predictions": ADDED_NPZ,
        },
        DIGITS,
    )
    return rounded
