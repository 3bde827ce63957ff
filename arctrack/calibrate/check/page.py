"""calibrate_check.html: what a recording says of a setup, stage by stage, with pictures."""

import numpy as np
from matplotlib.axes import Axes

from arctrack.calibrate.check.check_setup import SetupCheck
from arctrack.calibrate.check.measure import LightStage, SetupVerdict
from arctrack.calibrate.page import PagePicture
from arctrack.report import style
from arctrack.report.embedded import svg
from arctrack.report.image import visible
from arctrack.report.template import environment
from calibration.check.arc_light import ArcLightCheck
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.joint import NOMINAL_SEAM, SeamLine
from tracker.geometry import SensorGeometry
from tracker.stripe.expected import expect_stripe

MARKS = {SetupVerdict.OK: "no_gap", SetupVerdict.NOT_EXPLAINED: "unknown", SetupVerdict.UNTOLD: "ambiguous"}

SHAPE_RANGE = 0.1
"""End of the colour scale of the arc map's error, relative."""


def render(checked: SetupCheck) -> str:
    """Return the page's HTML, which needs no other file and no network."""
    stages = [
        (
            stage.value,
            checked.verdict_of(stage).value,
            MARKS[checked.verdict_of(stage)],
            [
                (measure, *measure.shown, MARKS[measure.verdict])
                for measure in checked.measures
                if measure.stage is stage
            ],
        )
        for stage in LightStage
    ]
    pictures = []
    if checked.sights:
        pictures.append(
            PagePicture(
                _stripes(checked),
                "the stripe seen and expected, over the first and the last frame looked at; brightness by √",
                "Orange is where the setup puts the stripe at the nominal seam. Green is where it would "
                "lie with the part, or what else most likely is off, set right.",
            )
        )
    if checked.arc is not None:
        pictures.append(
            PagePicture(
                _arc(checked.arc),
                "the arc's level in each frame, and the error of its map in the brightest frame",
                "All levels alike at another height than 1 are the arc's output. A pattern over the image "
                "is the map's shape.",
            )
        )
    mark = "unknown" if checked.not_explained else "no_gap"
    return (
        environment()
        .get_template("setup_check.html.j2")
        .render(
            name=checked.recording.name,
            setup=str(checked.recording.setup_path),
            headline=checked.headline,
            sentences=checked.sentences,
            stages=stages,
            pictures=pictures,
            mark=mark,
        )
    )


def _stripes(checked: SetupCheck) -> str:
    looks = [look for look in checked.looks if look.pose is not None and len(look.line.scan)]
    shown = sorted({0, len(looks) - 1})
    camera = checked.setup.camera
    figure = style.new_figure(10.5, 0.6 + 10.5 / len(shown) * camera.height / camera.width, "")
    cells = figure.subplots(1, len(shown), squeeze=False)[0]
    place = checked.mended or checked.place
    for axes, n in zip(cells, shown, strict=True):
        look, sight = looks[n], checked.sights[n]
        axes.set_title(f"frame {look.frame.index}", fontsize=9, loc="left")
        axes.imshow(visible(look.frame.image_dn, checked.setup.sensor), cmap="gray", vmin=0, vmax=255)
        axes.plot(*sight.points_px.T, ".", color=style.SKY, markersize=2, rasterized=True, label="seen")
        _draw(axes, checked.setup, sight.T_base_tool, NOMINAL_SEAM, style.ORANGE, "expected")
        if place is not None:
            label = "part set right" if checked.mended is None else "set right"
            _draw(axes, place.fitted_setup, sight.T_base_tool, place.seam, style.GREEN, label)
        style.over_image(axes, camera.width, camera.height)
        axes.set_axis_off()
    cells[0].legend(fontsize=8, loc="upper right")
    return svg(figure)


def _draw(axes: Axes, setup: Setup, T_base_tool: Float64, seam: SeamLine, colour: str, label: str) -> None:
    try:
        geometry = SensorGeometry.of(setup)
        scene = make_scene(geometry.setup, T_base_tool, seam)
        stripe = None if scene.below_surface else expect_stripe(geometry, scene)
    except ValueError:
        stripe = None
    if stripe is None:
        return
    scan = np.arange(geometry.n_scan, dtype=np.float64)
    axes.plot(*geometry.image_points(scan, stripe.shown_px).T, color=colour, linewidth=1.2, label=label)


def _arc(arc: ArcLightCheck) -> str:
    figure = style.new_figure(10.5, 3.6, "")
    levels, shape = figure.subplots(1, 2)
    style.plain(levels, "frame", "level over the expected one")
    levels.plot(
        [f.frame.index for f in arc.frames],
        [f.level for f in arc.frames],
        "o",
        color=style.BLUE,
        markersize=5,
    )
    levels.axhline(1.0, color=style.BLACK, linewidth=0.8)
    brightest = max(arc.frames, key=lambda f: float(np.median(f.charge_e)))
    style.plain(shape, "column [px]", "row [px]", f"frame {brightest.frame.index}: charge over the fit − 1")
    drawn = shape.scatter(
        *brightest.uv_px.T, c=brightest.off, cmap="RdBu_r", vmin=-SHAPE_RANGE, vmax=SHAPE_RANGE, s=14
    )
    height, width = brightest.frame.image_dn.shape
    style.over_image(shape, width, height)
    shape.set_aspect("equal")
    figure.colorbar(drawn, ax=shape)
    return svg(figure)
