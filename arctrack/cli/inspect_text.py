"""A recording in words."""

import math
from typing import Any

from rich.console import Console
from rich.table import Table

from arctrack.check.survey import ConditionSummary, MotionSummary, Survey
from arctrack.printable import cut, first_of, printable
from arctrack.recording import Recording
from noise_model.instrument.spectrum import Filter, FilterCurve
from noise_model.setup import Setup
from tracker.seam.correction import UNSTATED, AxisCorrection, Correction


def print_survey(console: Console, recording: Recording, survey: Survey) -> None:
    """Print what a recording holds: its setup, its conditions, its poses."""
    lines = [("recording", _extent(recording)), *setup_lines(recording.setup), *motion_lines(survey.motion)]
    if recording.has_truth:
        lines.append(("truth", "truth.csv holds the true seam points, for scoring"))
    if recording.correction != UNSTATED:
        lines.append(("follow", correction_words(recording.correction)))
    if recording.setup.effects:
        lines.append(("effects", f"known beforehand: {', '.join(recording.setup.effects)}"))
    lines.append(("unknown keys", ", ".join(first_of(map(cut, recording.unknown_keys), "more")) or "none"))
    lines.append(("warnings", str(len(recording.warnings)) if recording.warnings else "none"))
    width = max(len(name) for name, _ in lines)
    for name, text in lines:
        console.print(f"[bold]{name:<{width}}[/bold]  ", end="")
        console.print(printable(text), markup=False, soft_wrap=True)
    console.print(condition_table(survey.conditions))


def survey_json(recording: Recording, survey: Survey) -> dict[str, Any]:
    """Return a recording's content for programs."""
    setup, rows = recording.setup, recording.rows
    conditions = [
        {name: value for name, value in vars(condition).items() if name != "sample"}
        for condition in survey.conditions
    ]
    return {
        "recording": recording.path,
        "setup": recording.setup_path,
        "frames": len(rows),
        "first_s": rows[0].timestamp_s,
        "last_s": rows[-1].timestamp_s,
        "frame_rate_hz": recording.frame_rate_hz,
        "width_px": setup.camera.width,
        "height_px": setup.camera.height,
        "bits": setup.sensor.bits,
        "joint": setup.joint.type,
        "material": setup.material.name,
        "effects": list(setup.effects),
        "conditions": conditions,
        "motion": vars(survey.motion),
        "has_truth": recording.has_truth,
        "unknown_keys": recording.unknown_keys,
        "warnings": recording.warnings,
        "unusable_frames": [bad.message for bad in survey.bad_frames],
    }


def correction_words(correction: Correction) -> str:
    """Return the stated parts of the correction that differ from the default."""
    words = []
    for table, stated, unstated in (
        ("", correction, UNSTATED),
        ("y.", correction.y, UNSTATED.y),
        ("z.", correction.z, UNSTATED.z),
    ):
        for name, value in vars(stated).items():
            if value != getattr(unstated, name) and not isinstance(value, AxisCorrection):
                words.append(f"{table}{name} {str(value).lower()}")
    return ", ".join(words)


def _filter_words(of_filter: Filter | FilterCurve | None) -> str:
    return "none" if of_filter is None else f"{of_filter.center_nm:g} nm, {of_filter.fwhm_nm:g} nm wide"


def setup_lines(setup: Setup) -> list[tuple[str, str]]:
    """Return the nominal setup in words, a line a part."""
    return [
        ("camera", str(setup.camera)),
        ("sensor", str(setup.sensor)),
        ("filter", _filter_words(setup.filter)),
        ("laser", str(setup.laser)),
        ("arc", str(setup.arc)),
        ("material", str(setup.material)),
        ("joint", str(setup.joint)),
        ("tolerance", str(setup.tolerance)),
        *(
            []
            if setup.calibration is None
            else [("calibration", "camera and sheet by [calibration.geometry], in place of the hand-eye's")]
        ),
    ]


def motion_lines(motion: MotionSummary) -> list[tuple[str, str]]:
    """Return the robot's motion in words, in two lines."""
    return [
        (
            "poses",
            f"{motion.rate_hz:.1f} Hz from {motion.first_s:.3f} to {motion.last_s:.3f} s, jitter "
            f"{1000 * motion.jitter_s:.2f} ms, longest gap {1000 * motion.longest_gap_s:.1f} ms",
        ),
        (
            "motion",
            f"{motion.travel_mm:.1f} mm at {motion.travel_speed_mm_s:.2f} mm/s; tool "
            f"{motion.lateral_mm[0]:+.2f} to {motion.lateral_mm[1]:+.2f} mm beside the nominal seam, "
            f"{motion.height_mm[0]:.2f} to {motion.height_mm[1]:.2f} mm above it, "
            f"tilted up to {motion.tilt_deg:.1f} deg",
        ),
    ]


def condition_table(conditions: tuple[ConditionSummary, ...]) -> Table:
    """Return one row a condition."""
    table = Table("laser", "arc", title="Conditions", title_justify="left")
    for name in ("current A", "exposure ms", "frames", "mean DN", "max DN", "saturated %"):
        table.add_column(name, justify="right")
    for condition in conditions:
        usable = condition.sample is not None
        cells = (
            "on" if condition.laser_on else "off",
            "on" if condition.arc_on else "off",
            f"{condition.current_a:g}" if math.isfinite(condition.current_a) else "?",
            f"{1000 * condition.exposure_s:g}",
            str(condition.frames),
            f"{condition.mean_dn:.1f}" if usable else "",
            str(condition.brightest_dn) if usable else "",
            f"{100 * condition.saturated_share:.2f}" if usable else "",
        )
        table.add_row(*cells)
    return table


def _extent(recording: Recording) -> str:
    rows = recording.rows
    rate = recording.frame_rate_hz
    span = f", {rows[-1].timestamp_s - rows[0].timestamp_s:.2f} s at {rate:.2f} Hz" if rate == rate else ""
    return f"{recording.path}: {len(rows)} frames in {recording.frame_source.name}{span}"
