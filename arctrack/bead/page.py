"""bead.html: a seam's bead on one page."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from arctrack.bead.seam_result import BeadLimits, Evaluation, Slice
from arctrack.calibrate.page import CalibrationPage, PagePicture, row_of
from arctrack.report import style
from arctrack.report.embedded import svg
from noise_model.compiled.arrays import Float64
from noise_model.even_sample import evenly
from tracker.bead import MEASURES

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
