"""calibrate_gauge.html: the laser sheet from a gauge, or a check of it, in words and pictures."""

import math
from collections.abc import Sequence

import numpy as np

from arctrack.calibrate.gauge.gauge_images import GaugeImages
from arctrack.calibrate.laser.page import plane_in_words, plane_rows, turned_deg
from arctrack.calibrate.page import CalibrationPage, PagePicture, row_of, with_reasons
from arctrack.report import style
from arctrack.report.embedded import svg
from calibration.gauge.adjustment import GaugeFit, GaugeProblem
from calibration.gauge.calibrate import GaugeCalibration, GaugeCheck
from calibration.gauge.shape import Gauge, Shape
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup

NOT_IN_SIGMAS = "The camera's pose in the tool and the lens count as exact in the sigmas of this page."


def gauge_page(result: GaugeCalibration, images: GaugeImages, setup: Setup) -> CalibrationPage:
    """Return the content of a calibration's page."""
    lean = np.degrees(result.sigma[:2])
    robot_mm, form_mm = result.fitted.noise_mm
    moved_mm = float((result.plane - setup.laser.plane) @ [*result.fitted.state.centre_mm, 1.0])
    sentences = (
        f"{len(result.problem.sightings)} images of {result.problem.gauge}. Amid the points the sheet is "
        f"known to {result.sigma[2]:.3f} mm along its normal, its two leans to {lean[0]:.3f}° and "
        f"{lean[1]:.3f}°, 1 σ.",
        f"It is turned by {turned_deg(result.plane, setup):.2f}° against the one stated before, and "
        f"{abs(moved_mm):.3f} mm away from it amid the points. The stated origin is moved into it.",
        f"From pose to pose the gauge lies {robot_mm:.3f} mm off (1 σ in each direction): the robot's "
        f"inaccuracy, or the camera's pose. Along a piece of the stripe {form_mm:.3f} mm are left.",
    )
    return CalibrationPage(
        title="arctrack calibrates the laser sheet by a gauge",
        label="laser plane",
        headline=plane_in_words(result.plane),
        sentences=sentences,
        rows=plane_rows(result.plane, result.covariance),
        pictures=_pictures(result.problem, result.fitted, images),
        notes=(NOT_IN_SIGMAS,),
        mark="no_gap",
        left_out=with_reasons(images.left_out | result.left_out),
    )


def check_page(
    checks: Sequence[GaugeCheck], images: GaugeImages, line: str, cure: str, is_good: bool
) -> CalibrationPage:
    """Return the content of a check's page; `line` is its verdict."""
    rows = []
    for check in checks:
        count = len(check.problem.sightings)
        name = check.problem.sightings[0].name if count == 1 else f"{count} images"
        rows.append(row_of("the gauge's size", name, check.size_mm, check.sigma_mm, "mm"))
    left_out = dict(images.left_out)
    for check in checks:
        left_out |= check.left_out
    first = checks[0]
    return CalibrationPage(
        title="arctrack checks the laser sheet by a gauge",
        label=str(first.problem.gauge),
        headline=line,
        sentences=(f"{cure[0].upper()}{cure[1:]}.",) if cure else (),
        rows=tuple(rows),
        pictures=_pictures(first.problem, first.fitted, images),
        notes=(NOT_IN_SIGMAS,),
        mark="no_gap" if is_good else "ambiguous",
        left_out=with_reasons(left_out),
    )


def _pictures(problem: GaugeProblem, fitted: GaugeFit, images: GaugeImages) -> tuple[PagePicture, ...]:
    return (
        PagePicture(_image(images), "the stripe's pieces in the first image", "At corners it is left out."),
        PagePicture(
            _section(problem, fitted),
            "all images' pieces across the gauge, and the gauge itself",
            "Where sheet, camera and robot are right, all lie on the gauge.",
        ),
        off_picture(problem, fitted),
    )


def _image(images: GaugeImages) -> str:
    lens = images.lens
    figure = style.new_figure(7.0, 0.5 + 7.0 * lens.height / lens.width, "")
    axes = style.plain(figure.add_subplot(), "column [px]", "row [px]")
    if images.sample is not None and images.sample_pieces is not None:
        low, high = np.percentile(images.sample, [1.0, 99.9])
        axes.imshow(images.sample, cmap="gray", vmin=low, vmax=max(high, low + 1.0))
        for piece in images.sample_pieces.pieces:
            axes.plot(*piece.points_px.T, ".", markersize=1.5, rasterized=True)
    axes.grid(visible=False)
    return svg(figure)


def _outline(gauge: Gauge, reach_mm: float) -> Float64:
    """Return the gauge's outline (n, 2) across it."""
    if gauge.shape is Shape.STEP:
        return np.array([[-reach_mm, 0.0], [0.0, 0.0], [0.0, -gauge.size_mm], [reach_mm, -gauge.size_mm]])
    mouth = gauge.size_mm * math.tan(math.radians(0.5 * gauge.angle_deg))
    reach_mm = max(reach_mm, 1.2 * mouth)
    return np.array([[-reach_mm, 0.0], [-mouth, 0.0], [0.0, -gauge.size_mm], [mouth, 0.0], [reach_mm, 0.0]])


def _section(problem: GaugeProblem, fitted: GaugeFit) -> str:
    figure = style.new_figure(10.5, 4.2, "")
    axes = style.plain(figure.add_subplot(), "across the gauge [mm]", "out of its top [mm]")
    T = fitted.state.T_base_gauge
    places = (problem.points_base(fitted.state) - T[:3, 3]) @ T[:3, :3]
    outline = _outline(problem.gauge, float(np.abs(places[:, 1]).max()))
    axes.plot(*outline.T, "-", color=style.BLACK, linewidth=0.8)
    for part in problem.slices:
        ends = places[part]
        for n in range(0, len(ends) - 1, 2):
            axes.plot(ends[n : n + 2, 1], ends[n : n + 2, 2], "-", color=style.BLUE, linewidth=1.0, alpha=0.6)
    axes.set_aspect("equal", adjustable="datalim")
    return svg(figure)


def off_picture(problem: GaugeProblem, fitted: GaugeFit) -> PagePicture:
    """Return the picture of the points' distances from the gauge's faces."""
    noun = problem.gauge.noun
    figure = style.new_figure(10.5, 3.6, "")
    axes = style.plain(figure.add_subplot(), "", f"off the {noun} [mm]")
    off = problem.distances(fitted.state)
    for n, part in enumerate(problem.slices):
        axes.plot(np.full(part.stop - part.start, n), off[part], "o", color=style.BLUE, markersize=3)
    axes.axhline(0.0, color=style.BLACK, linewidth=0.8)
    names = [sighting.name for sighting in problem.sightings]
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    return PagePicture(svg(figure), f"how far the points are off the {noun}, image by image")
