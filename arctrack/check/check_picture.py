"""The picture of `arctrack check`: frames with the predicted stripe over them."""

import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from arctrack.check.check_recording import CheckResult
from arctrack.check.check_sample import CheckCase
from arctrack.report import style
from arctrack.report.image import visible
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from tracker.geometry import SEARCH_REACH_MM, SensorGeometry
from tracker.stripe.expected import expect_stripe

TITLE_LETTERS = 120
"""A longer title goes over several lines."""


def draw(checked: CheckResult) -> Figure:
    """Return the picture of two frames: one without arc and one with it, where there are both."""
    said = checked.verdict.line if checked.refusal is None else str(checked.refusal)
    title = textwrap.fill(f"{checked.recording.name}: {said}", TITLE_LETTERS)
    case = checked.case
    if case is None:
        return style.new_figure(13.5, 1.5, f"{checked.recording.name}: no image can be read")
    shown = _shown(case)
    undone = None if checked.hint is None else checked.hint.case
    rows = 1 if undone is None else 2
    width, height = case.size_px
    figure = style.new_figure(13.5, rows * (6.2 * height / width + 0.5) + 0.5, title)
    cells = figure.subplots(rows, 2, squeeze=False)
    for axes in cells.ravel():
        axes.set_axis_off()
    for axes, index in zip(cells[0], shown, strict=False):
        _frame(axes, case, index)
    if undone is not None and checked.hint is not None:
        for axes, index in zip(cells[1], shown, strict=False):
            _undone(axes, undone, index)
            axes.set_title(f"if {checked.hint.what}", fontsize=9, loc="left")
    cells[0, 0].legend(fontsize=8, loc="upper right")
    return figure


def _shown(case: CheckCase) -> list[int]:
    """Return the first frame without arc and the middle one with it; any, where all are the same."""
    dark = [n for n, row in enumerate(case.rows) if not row.arc_on]
    lit = [n for n, row in enumerate(case.rows) if row.arc_on]
    chosen = [*dark[:1], *lit[len(lit) // 2 :][:1]]
    return chosen if len(chosen) == 2 else sorted({0, len(case.rows) - 1})


def _frame(axes: Axes, case: CheckCase, index: int) -> None:
    """Draw a frame, the stripe as predicted, how far about it the seam is sought, and the line found."""
    row, image = case.rows[index], case.images_dn[index]
    lit = "laser + arc" if row.arc_on else "laser"
    title = f"frame {row.index}, {lit}, {1e3 * row.exposure_s:g} ms; brightness by √"
    axes.set_title(title, fontsize=9, loc="left")
    axes.imshow(visible(image, case.setup.sensor), cmap="gray", vmin=0, vmax=255)
    axes.plot(*case.points_px[index].T, ".", color=style.SKY, markersize=1.5, label="bright line found")
    if case.fits_camera:
        _predicted(axes, case.setup, case.T_base_tool[index], style.ORANGE)
    _set_limits(axes, *case.size_px)


def _undone(axes: Axes, case: CheckCase, index: int) -> None:
    """Draw the same line and the predicted stripe, a mistake undone."""
    axes.set_axis_on()
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_facecolor("#222222")
    axes.plot(*case.points_px[index].T, ".", color=style.SKY, markersize=1.5)
    _predicted(axes, case.setup, case.T_base_tool[index], style.GREEN)
    _set_limits(axes, *case.size_px)


def _predicted(axes: Axes, setup: Setup, T_base_tool: Float64, color: str) -> None:
    stripe = _stripe_px(setup, T_base_tool)
    if stripe is None:
        axes.text(0.02, 0.04, "no stripe is predicted in view", color=color, transform=axes.transAxes)
        return
    middle, *rims = stripe
    axes.plot(*middle.T, color=color, linewidth=1.2, dashes=(6, 4), label="predicted, nominal seam")
    for rim in rims:
        axes.plot(*rim.T, color=color, linewidth=0.6, alpha=0.7)


def _stripe_px(setup: Setup, T_base_tool: Float64) -> tuple[Float64, Float64, Float64] | None:
    """Return image points (n, 2) x y of the nominal stripe and the search's rims; None out of view."""
    if not np.isfinite(T_base_tool).all():
        return None
    try:
        geometry = SensorGeometry.of(setup)
        scene = make_scene(setup, T_base_tool)
    except ValueError:
        return None
    expected = None if scene.below_surface else expect_stripe(geometry, scene)
    if expected is None:
        return None
    scan, reach_px = np.arange(geometry.n_scan, dtype=np.float64), geometry.reach_px(SEARCH_REACH_MM)
    middle, low, high = (
        geometry.image_points(scan, expected.shown_px + off) for off in (0.0, -reach_px, reach_px)
    )
    return middle, low, high


def _set_limits(axes: Axes, width: int, height: int) -> None:
    style.over_image(axes, width, height)
    axes.set_aspect("equal")
