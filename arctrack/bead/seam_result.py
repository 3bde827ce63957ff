"""seam.json and bead.html: a seam's bead against its limits, in the form of a joining result of OPC 40450-1.

Names of fields and values of evaluations are those of its tables 193 and 197, and of OPC 40001-101.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import IntEnum
from typing import Any
from uuid import uuid4

import numpy as np

from arctrack.calibrate.page import CalibrationPage, PagePicture, row_of
from arctrack.errors import ArctrackError, in_file
from arctrack.recording import BadFrame, Recording
from arctrack.report import style
from arctrack.report.embedded import svg
from noise_model.compiled.arrays import Float64
from noise_model.even_sample import evenly
from tracker.bead import MEASURES, Bead, BeadMeasure, measure_beads

SINGLE_RESULT = 1
"""The classification of one seam's result."""

SURE_SIGMAS = 3.0
"""A value within so many of its sigmas of a limit does not decide on which side it lies."""


class Evaluation(IntEnum):
    """Evaluation of a value by its limits."""

    UNDEFINED = 0
    OK = 1
    NOT_OK = 2
    NOT_DECIDABLE = 3


@dataclass(frozen=True)
class BeadLimits:
    """The least and the largest value that are allowed."""

    low: float = -math.inf
    high: float = math.inf

    def __str__(self) -> str:
        ends = (f"at least {self.low:g}", self.low), (f"at most {self.high:g}", self.high)
        return " and ".join(words for words, end in ends if math.isfinite(end))

    def evaluate(self, measure: BeadMeasure) -> Evaluation:
        """Return on which side of the limits a value lies."""
        reach = SURE_SIGMAS * measure.sigma
        if measure.value - reach > self.high or measure.value + reach < self.low:
            return Evaluation.NOT_OK
        if measure.value + reach <= self.high and measure.value - reach >= self.low:
            return Evaluation.OK
        return Evaluation.NOT_DECIDABLE


@dataclass(frozen=True)
class Slice:
    """One frame's bead."""

    frame: int
    timestamp_s: float
    bead: Bead


def read_limits(texts: Sequence[str]) -> dict[str, BeadLimits]:
    """Return the limits of options NAME=LOW:HIGH, one end of which may be empty; ArctrackError for others."""
    limits: dict[str, BeadLimits] = {}
    for text in texts:
        name, _, ends = text.partition("=")
        low, colon, high = ends.partition(":")
        if name not in MEASURES:
            raise ArctrackError(f"--limit {text}: the measures are {', '.join(MEASURES)}")
        try:
            limits[name] = BeadLimits(float(low or "-inf"), float(high or "inf"))
        except ValueError:
            colon = ""
        if not colon or not limits[name].low < limits[name].high:
            raise ArctrackError(f"--limit {text}: give NAME=LOW:HIGH, such as width_mm=4:8 or width_mm=:8")
    return limits


def measured_slices(
    recording: Recording, progress: Callable[[int, int], None]
) -> tuple[list[Slice], list[tuple[Float64, Float64]]]:
    """Measure the bead in all frames of a profiler's recording; return their places and heights (n,) too.

    Raises ArctrackError for a camera's recording, and where no frame has the laser on.
    """
    profiler = recording.setup.profiler
    if profiler is None:
        raise in_file(recording.path, 'a bead is measured in profiles: [camera] kind = "profile"')
    lit = [n for n, row in enumerate(recording.rows) if row.laser_on]
    if not lit:
        raise in_file(recording.path, "has no frame with the laser on")
    nothing = np.full(profiler.columns, np.nan)
    heights = [
        nothing if isinstance(frame, BadFrame) else profiler.z_mm(frame.image_dn[0])
        for frame in recording.frames(lit)
    ]
    profiles = [(profiler.y_mm, z_mm) for z_mm in heights]
    slices: list[Slice] = []
    for n, bead in zip(lit, measure_beads(profiles), strict=True):
        slices.append(Slice(recording.rows[n].index, recording.rows[n].timestamp_s, bead))
        progress(len(slices), len(lit))
    return slices, profiles


def evaluation_of(slices: Sequence[Slice], limits: Mapping[str, BeadLimits]) -> Evaluation:
    """Return a seam's evaluation: one slice that is not as allowed decides, then one that does not tell."""
    judged = {
        Evaluation.NOT_DECIDABLE
        if name not in part.bead.measures
        else limit.evaluate(part.bead.measures[name])
        for part in slices
        for name, limit in limits.items()
    }
    order = (Evaluation.NOT_OK, Evaluation.NOT_DECIDABLE, Evaluation.OK)
    return next((evaluation for evaluation in order if evaluation in judged), Evaluation.UNDEFINED)


def overall(slices: Sequence[Slice], limits: Mapping[str, BeadLimits]) -> list[dict[str, Any]]:
    """Return each measure over the seam: its mean, smallest and largest value, and its evaluation."""
    values = []
    for name in MEASURES:
        seen = [part.bead.measures[name] for part in slices if name in part.bead.measures]
        if not seen:
            continue
        limit = limits.get(name)
        values.append(
            {
                "Name": name,
                "MeasuredValue": float(np.mean([measure.value for measure in seen])),
                # Slices share the calibration and lie close together: their errors are not independent.
                "Sigma": float(np.sqrt(np.mean([measure.sigma**2 for measure in seen]))),
                "Smallest": min(measure.value for measure in seen),
                "Largest": max(measure.value for measure in seen),
                "EngineeringUnits": name.rpartition("_")[2],
                **({} if limit is None else _ends(limit)),
                "ResultEvaluation": evaluation_of(slices, {} if limit is None else {name: limit}).value,
            }
        )
    return values


def _ends(limit: BeadLimits) -> dict[str, float]:
    ends = {"LowLimit": limit.low, "HighLimit": limit.high}
    return {name: end for name, end in ends.items() if math.isfinite(end)}


def seam_result(
    recording: Recording, slices: Sequence[Slice], limits: Mapping[str, BeadLimits], duration_s: float
) -> dict[str, Any]:
    """Return the content of seam.json; `duration_s` is the time that the measuring took."""
    now = datetime.now(UTC)
    problems = [part for part in slices if part.bead.problem]
    return {
        "ResultMetaData": {
            "ResultId": str(uuid4()),
            "Name": recording.name,
            "JoiningTechnology": "Welding",
            "Classification": SINGLE_RESULT,
            "IsSimulated": recording.has_truth,
            "IsPartial": bool(problems),
            "CreationTime": now.isoformat(),
            "ProcessingTimes": {
                "StartTime": slices[0].timestamp_s,
                "EndTime": slices[-1].timestamp_s,
                "ProcessingDuration": 1e3 * duration_s,
            },
            "ResultEvaluation": evaluation_of(slices, limits).value,
        },
        "ResultContent": {
            "OverallResultValues": overall(slices, limits),
            "Slices": [
                {
                    "frame": part.frame,
                    "timestamp_s": part.timestamp_s,
                    "problem": part.bead.problem or None,
                    **{name: measure._asdict() for name, measure in part.bead.measures.items()},
                }
                for part in slices
            ],
        },
    }


VERDICTS = {
    Evaluation.UNDEFINED: ("ambiguous", "no limit stated"),
    Evaluation.OK: ("no_gap", "within the limits"),
    Evaluation.NOT_OK: ("unknown", "beyond a limit"),
    Evaluation.NOT_DECIDABLE: ("ambiguous", "not decidable"),
}
"""Colour and word of each evaluation."""

DRAWN = 4
"""Slices that are drawn, evenly over the seam."""


def bead_page(
    result: Mapping[str, Any],
    slices: Sequence[Slice],
    profiles: Sequence[tuple[Float64, Float64]],
    limits: Mapping[str, BeadLimits],
) -> CalibrationPage:
    """Return the page's content.

    `result` is that of `seam_result`, `profiles` are places and heights (n,) of each slice, mm.
    """
    about, content = result["ResultMetaData"], result["ResultContent"]
    mark, word = VERDICTS[Evaluation(about["ResultEvaluation"])]
    seen = [n for n, part in enumerate(slices) if not part.bead.problem]
    rows = [
        row_of(
            f"{MEASURES[value['Name']]}, {value['Smallest']:.2f} to {value['Largest']:.2f}",
            value["Name"],
            value["MeasuredValue"],
            value["Sigma"],
            value["EngineeringUnits"],
        )
        for value in content["OverallResultValues"]
    ]
    stated = [f"{name} {limit}" for name, limit in limits.items()]
    return CalibrationPage(
        title=f"arctrack measures the bead of {about['Name']}",
        label=word,
        headline=f"{len(seen)} of {len(slices)} profiles show the bead.",
        sentences=(
            "Each value is the mean over the seam, with its smallest and largest; σ is that of one profile.",
            f"Limits: {', '.join(stated) or 'none'}.",
        ),
        rows=tuple(rows),
        pictures=(
            PagePicture(_sections(slices, profiles, seen), "profiles with the bead's face and toes"),
            PagePicture(_along(slices, seen, limits), "values along the seam, with 2 σ and limits"),
        )
        if seen
        else (),
        mark=mark,
        left_out=tuple(f"frame {part.frame}: {part.bead.problem}" for part in slices if part.bead.problem),
    )


def _sections(
    slices: Sequence[Slice], profiles: Sequence[tuple[Float64, Float64]], seen: Sequence[int]
) -> str:
    drawn = [seen[n] for n in evenly(len(seen), DRAWN)]
    figure = style.new_figure(10.5, 2.2 * len(drawn), "")
    for axes, n in zip(np.atleast_1d(figure.subplots(len(drawn), 1, sharex=True)), drawn, strict=True):
        bead = slices[n].bead
        style.plain(axes, "y, to the left [mm]", f"frame {slices[n].frame}: z [mm]")
        axes.plot(*profiles[n], ".", color=style.SKY, markersize=2.0, label="profile")
        axes.plot(*bead.face_mm.T, color=style.BLACK, linewidth=1.0, label="plates and face")
        for toe in ("toe_right_mm", "toe_left_mm"):
            axes.axvline(bead.measures[toe].value, color=style.ORANGE, linewidth=1.0)
    return svg(figure)


def _along(slices: Sequence[Slice], seen: Sequence[int], limits: Mapping[str, BeadLimits]) -> str:
    names = [name for name in MEASURES if name in slices[seen[0]].bead.measures]
    figure = style.new_figure(10.5, 1.5 * len(names), "")
    for axes, name in zip(figure.subplots(len(names), 1, sharex=True), names, strict=True):
        shown = [n for n in seen if name in slices[n].bead.measures]
        values, sigmas = np.array([slices[n].bead.measures[name] for n in shown]).T
        style.plain(axes, "frame", name)
        axes.errorbar([slices[n].frame for n in shown], values, 2.0 * sigmas, fmt=".", color=style.BLUE)
        limit = limits.get(name, BeadLimits())
        for end in (limit.low, limit.high):
            if np.isfinite(end):
                axes.axhline(end, color=style.ORANGE, linewidth=1.0)
    return svg(figure)
