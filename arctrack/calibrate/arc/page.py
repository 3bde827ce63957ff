"""calibrate_arc.html: the arc and its metal in words and pictures."""

import numpy as np

from arctrack.calibrate.page import CalibrationPage, PagePicture, ValueRow, row_of, with_sigma
from arctrack.recording import Recording
from arctrack.report import style
from arctrack.report.embedded import svg
from calibration.arc.calibrate import KEYS, ArcCalibration, Combination
from calibration.arc.problem import C2, RADIANCE, RADIUS, RATIO, X, Y, Z

WORDS = (
    "radius",
    "centre, along the travel",
    "centre, to its left",
    "centre, height",
    "brightness",
    "diffuse reflectance",
    "specular reflectance",
    "narrowness of the lobe",
)
UNITS = ("mm", "mm", "mm", "mm", "e-", "1/sr", "1/sr", "1/rad²")

NAMES = {
    RADIUS: "radius",
    X: "centre along the travel",
    Y: "centre to the left",
    Z: "height",
    RADIANCE: "brightness",
    RATIO: "kappa_spec over kappa_diff",
    C2: "c2",
}

CURES = {
    RADIUS: "frames that look nearer to the arc, within three of its radii",
    X: "frames with the tool turned about its z axis",
    Y: "frames with the tool turned about its z axis",
    Z: "frames that look nearer to the arc, and walls that it lights at another angle",
    RADIANCE: "frames of the arc alone below saturation",
    RATIO: "frames that look where the metal mirrors the arc: a groove's wall, or plates near the arc",
    C2: "frames that look where the metal mirrors the arc: a groove's wall, or plates near the arc",
}

RANGE = 0.1
"""End of the residuals' colour scale, relative."""


def arc_page(result: ArcCalibration, recording: Recording) -> CalibrationPage:
    """Return the page's content."""
    problem = result.problem
    height, height_sigma = with_sigma(float(result.values[3]), float(result.sigmas[3]))
    refused = [
        f"{NAMES[name]}: refused, 1 σ is {_wide(name, sigma)}; it stays as stated. What would tell: "
        f"{CURES[name]}."
        for name, sigma in result.refused.items()
    ]
    sentences = (
        f"{len(problem.frames)} frames of the arc alone, {len(problem.charge_e)} places in them. The metal's "
        f"texture is {100.0 * result.pixel_sigma:.1f} %, the arc flickers by {100.0 * result.flicker:.1f} %.",
        *refused,
        *(_combination(weak) for weak in result.combinations),
    )
    return CalibrationPage(
        title=f"arctrack calibrates the arc of {recording.name}",
        label="arc and metal",
        headline=f"height {height} ± {height_sigma} mm",
        sentences=sentences,
        rows=_rows(result),
        pictures=(
            PagePicture(
                _residuals(result),
                "what is left, relative to the arc's light: over the image, and in each frame (68 %)",
                "A pattern that all frames share is what the model lacks: arctrack diagnose names it.",
            ),
        ),
        notes=(
            "Brightness and the kappas' sum only occur as a product: the sum stays as stated.",
            "The sigmas hold the camera's tolerance, the part's place, texture and flicker.",
        ),
        mark="ambiguous" if result.refused else "no_gap",
    )


def _rows(result: ArcCalibration) -> tuple[ValueRow, ...]:
    rows = []
    for key, what, unit, value, sigma in zip(KEYS, WORDS, UNITS, result.values, result.sigmas, strict=True):
        if key in result.held_keys:
            rows.append(ValueRow(what, key, f"{value:.5g}", "", "as stated", unit))
            continue
        rows.append(row_of(what, key, value, sigma, unit, shown=_number))
    return tuple(rows)


def _number(value: float, sigma: float) -> tuple[str, str]:
    # Brightness has seven digits before its point.
    return (f"{value:.4g}", f"{sigma:.2g}") if abs(value) > 1e4 else with_sigma(value, sigma)


def _wide(name: str, sigma: float) -> str:
    return f"{sigma:.2f} mm" if name in (X, Y, Z) else f"{100.0 * sigma:.0f} %"


def _combination(weak: Combination) -> str:
    """Return in words what cannot be separated."""
    parts = sorted(weak.parts.items(), key=lambda part: -abs(part[1]))
    if len(parts) == 1:
        return f"The frames hardly tell: {NAMES[parts[0][0]]}."
    more = [NAMES[name] for name, part in parts if part > 0.0]
    less = [NAMES[name] for name, part in parts if part < 0.0]
    said = f"more {' and more '.join(more)}"
    said += f" with less {' and less '.join(less)}" if less else ", together,"
    return f"The frames hardly tell apart: {said} look alike."


def _residuals(result: ArcCalibration) -> str:
    problem = result.problem
    camera = problem.setup.camera
    uv = np.concatenate([lattice.uv_px for lattice in problem.frames])
    off = result.residuals
    figure = style.new_figure(10.5, 3.6, "")
    field, frames = figure.subplots(1, 2)
    style.plain(field, "column [px]", "row [px]", "mean over the frames")
    cells, which = np.unique(uv, axis=0, return_inverse=True)
    which = which.ravel()
    mean = np.bincount(which, off) / np.bincount(which)
    drawn = field.scatter(*cells.T, c=mean, cmap="RdBu_r", vmin=-RANGE, vmax=RANGE, s=12)
    style.over_image(field, camera.width, camera.height)
    field.set_aspect("equal")
    figure.colorbar(drawn, ax=field)
    style.plain(frames, "frame", "charge over the fit − 1")
    frame_of = np.argmax(problem.frame_of, axis=1)
    for n, lattice in enumerate(problem.frames):
        mine = off[frame_of == n]
        low, middle, high = np.percentile(mine, [16.0, 50.0, 84.0])
        frames.errorbar(
            lattice.frame.index, middle, [[middle - low], [high - middle]], fmt="o", color=style.BLUE
        )
    frames.axhline(0.0, color=style.BLACK, linewidth=0.8)
    return svg(figure)
