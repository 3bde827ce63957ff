"""Effects that a diagnosis named, added to a setup: how far they close the gap of frames that no fit saw."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from arctrack.diagnose.applied_files import AppliedEffects, write_applied_numbers
from arctrack.diagnose.diagnose import THREADS, DiagnosisJob, DiagnosisResult, OnStage, named_effects
from arctrack.diagnose.diagnosis_files import ADDED_PAGE, PREDICTED_NPZ, read_predictions
from arctrack.errors import ArctrackError, in_file
from arctrack.output import real
from arctrack.recording import Recording, pose_at, read_recording, require_images
from arctrack.recording.setup_file import setup_text, stated_keys
from noise_model.effects import Effects, checked
from noise_model.setup import Setup
from sim_to_real.diagnosis import NamedEffect

SAME_TABLES = ("units", "camera", "sensor", "filter", "laser", "arc", "material", "effects")
"""Tables of recording.toml in which an effect was fitted: only beside the same ones does it mean the same."""


def other_recording(job: DiagnosisJob, other: Path) -> Recording:
    """Return another recording of a job's cell, on which its effects can be predicted.

    Raises ArctrackError for the recording itself, for one without a kind of frames of the job's, and for one
    whose setup differs where effects are fitted.
    """
    if real(other) == real(job.recording):
        raise in_file(other, "--on is the recording that is diagnosed: leave --on out, or give another one")
    fitted, there = (read_recording(path, job.setup_path) for path in (job.recording, other.absolute()))
    require_images(there.setup, there.setup_path, "give a recording of images with --on")
    stated, stated_there = (_stated(recording) for recording in (fitted, there))
    key = _first_difference({name: stated[name] for name in SAME_TABLES}, stated_there)
    if key is not None:
        raise in_file(
            there.setup_path,
            f"{key}: differs from {fitted.name}'s, so an effect that was fitted there means something else "
            "here; state both alike",
        )
    kinds, kinds_there = (
        {_kind(row.laser_on, row.arc_on) for row in recording.rows} for recording in (fitted, there)
    )
    if not kinds & kinds_there:
        raise in_file(
            other,
            f"has {_listed(kinds_there)} frames and {fitted.name} {_listed(kinds)} ones: give a recording "
            "with frames of the same kind",
        )
    return there


def apply_to_other(diagnosed: DiagnosisResult, other: Recording, on_stage: OnStage) -> AppliedEffects:
    """Predict another recording with its setup as it is, and with the effects that a verdict names.

    Raises ArctrackError if the verdict names none, and for frames of which none can be held out.
    """
    from sim_to_real.added_effects import predict_with_added

    effects = named_effects(diagnosed.diagnosis)
    if not effects:
        raise ArctrackError(
            f"{diagnosed.job.recording}: --on {other.path} was not predicted: the verdict "
            f"{diagnosed.diagnosis.verdict.value!r} names no effect that could be added"
        )
    frames, _ = other.readable_frames()
    poses = other.pose_buffer()
    try:
        added = predict_with_added(
            other.setup,
            frames,
            lambda timestamp_s: pose_at(poses, timestamp_s),
            _values(effects, other.setup),
            on_stage,
            THREADS,
        )
    except ValueError as error:
        raise in_file(other.path, str(error)) from error
    return AppliedEffects(
        effects=effects,
        fitted_on=diagnosed.job.name,
        on=other.name,
        setup=other.setup,
        gap=added.gap,
        predicted=added.predicted,
        n_fitted=added.n_fitted,
        is_other=True,
        folder=diagnosed.job.folder,
    )


def apply_to_own(diagnosed: DiagnosisResult) -> AppliedEffects:
    """Return the gap of a recording's own held-out frames, before and after its effects."""
    predicted = read_predictions(diagnosed.job.folder / PREDICTED_NPZ)
    return AppliedEffects(
        effects=named_effects(diagnosed.diagnosis),
        fitted_on=diagnosed.job.name,
        on=diagnosed.job.name,
        setup=diagnosed.setup,
        gap=diagnosed.diagnosis.gap,
        predicted=predicted,
        n_fitted=diagnosed.n_frames - len(predicted.frames),
        is_other=False,
        folder=diagnosed.job.folder,
    )


def write_applied(applied: AppliedEffects) -> None:
    """Write applied.npz, applied.json and applied.html; ArctrackError if one cannot be written."""
    from arctrack.diagnose.pages.applied_page import write_applied_page

    write_applied_numbers(applied)
    write_applied_page(applied, applied.folder / ADDED_PAGE)


def _values(effects: Sequence[NamedEffect], setup: Setup) -> Effects:
    """Return the parameters of effects, beside those that a setup states of them."""
    return checked(
        {
            effect.id: {
                **setup.effects.get(effect.id, {}),
                **{name: estimate.value for name, estimate in effect.parameters.items()},
            }
            for effect in effects
        }
    )


def _stated(recording: Recording) -> dict[str, Any]:
    """Return the keys that a recording's setup states."""
    path = recording.setup_path
    return stated_keys(setup_text(path), path).model_dump()


def _first_difference(first: Any, second: Any, key: str = "") -> str | None:
    """Return the first key in which values of two setup files differ, None if they are the same."""
    if not (isinstance(first, Mapping) and isinstance(second, Mapping)):
        return None if first == second else key
    for name in first:
        deeper = f"{key}.{name}" if key else name
        if name not in second or (differs := _first_difference(first[name], second[name], deeper)):
            return deeper if name not in second else differs
    return next((f"{key}.{name}" for name in second if key and name not in first), None)


def _kind(laser_on: bool, arc_on: bool) -> str:
    return {(0, 0): "dark", (1, 0): "laser", (0, 1): "arc", (1, 1): "laser and arc"}[laser_on, arc_on]


def _listed(kinds: set[str]) -> str:
    return ", ".join(sorted(kinds))
