"""Calibration of arc and metal from a recording with the arc on, and its page."""

import math
from collections.abc import Sequence

import numpy as np

from arctrack.calibrate.check.check_setup import sights_of
from arctrack.calibrate.check.light_measures import EXPOSURE_SIGMA, SPREAD_SIGMA
from arctrack.calibrate.check.measure import MAX_SIGMAS
from arctrack.calibrate.page import CalibrationPage, PagePicture, ValueRow, row_of, with_sigma
from arctrack.calibrate.stage import CalibrationStage, Steps
from arctrack.check.check_recording import parted
from arctrack.check.check_sample import case_of, chosen_rows
from arctrack.check.explanations import explains_as_stated, explanations
from arctrack.check.look import looks_at
from arctrack.errors import in_file
from arctrack.recording import CalibrationValues, Recording
from arctrack.recording.calibrated import Value
from arctrack.report import style
from arctrack.report.embedded import svg
from calibration.arc.calibrate import KEYS, ArcCalibration, Combination, calibrate_arc
from calibration.arc.problem import C2, RADIANCE, RADIUS, RATIO, PartPlacement, X, Y, Z
from calibration.check.arc_light import compare_arc
from calibration.check.stripe_place import StripePlace, locate_stripes
from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import NOMINAL_SEAM
from tracker.geometry import SensorGeometry
from tracker.state import Frame

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


MADE_BY = "arctrack calibrate arc"


def arc_records(result: ArcCalibration) -> tuple[CalibrationValues, ...]:
    """Return the determined values; what was refused stays as it is."""
    radius, *center, radiance, kappa_diff, kappa_spec, c2 = (float(f"{value:.8g}") for value in result.values)
    about: dict[str, float | int | str] = {
        "frames": len(result.problem.frames),
        "pixels": len(result.problem.charge_e),
        "texture": round(result.pixel_sigma, 5),
        "flicker": round(result.flicker, 5),
        "held_as_stated": ", ".join(result.held_keys),
    }
    arc: dict[str, Value] = {"radius_mm": radius, "center_in_tool_mm": center, "radiance_e": radiance}
    material: dict[str, Value] = {"kappa_diff": kappa_diff, "kappa_spec": kappa_spec, "c2": c2}
    determined = [
        {key: value for key, value in table.items() if key not in result.held_keys}
        for table in (arc, material)
    ]
    n_arc, radiance_at = 5, KEYS.index("radiance_e")
    # A variance in e-^2 would exceed the numbers that a setup holds, so it is relative.
    scale = np.ones(len(KEYS))
    scale[radiance_at] = 1.0 / radiance
    C = result.covariance * np.outer(scale, scale)
    names = tuple("radiance_rel" if key == "radiance_e" else key for key in KEYS)
    return (
        CalibrationValues("arc", determined[0], names[:n_arc], C[:n_arc, :n_arc], MADE_BY, about),
        CalibrationValues("material", determined[1], names[n_arc:], C[n_arc:, n_arc:], MADE_BY, about),
    )


def arc_stage(read: Recording, steps: Steps) -> CalibrationStage[ArcCalibration]:
    """Calibrate arc and metal from the frames with the arc on and the laser off.

    Frames with the laser on, where there are some, locate the part. Raises ArctrackError where no frame has
    the arc on and the laser off, where the stripes contradict the setup, and where nothing is determined.
    """
    rows = [n for n, row in enumerate(read.rows) if row.arc_on and not row.laser_on and row.current_a != 0.0]
    frames, bad_frames = parted(read.frames(rows))
    lit = [(frame, pose.T_base_tool) for frame, pose in read.posed(frames)]
    if not lit:
        raise in_file(
            read.path, "no frame has the arc on, the laser off and a pose: record some at several heights"
        )
    place = _place(read)
    case = None if place is None else case_of(read)
    if case is not None and not explains_as_stated(explanations(case)):
        raise in_file(
            read.path,
            "the stripe is not where the setup puts it: arctrack calibrate check says what is stale",
        )
    _refuse_bent_seam(read, place)
    _refuse_other_causes(read, lit, place)
    try:
        part = None if place is None else _part(place)
        result = calibrate_arc(read.setup, lit, part, steps("rounds", "rounds"))
    except ValueError as error:
        raise in_file(read.path, str(error)) from None
    return CalibrationStage(result, arc_page(result, read), arc_records(result), bad_frames=bad_frames)


def _refuse_bent_seam(read: Recording, place: StripePlace | None) -> None:
    """Raise ArctrackError where the seam leaves its nominal line: nobody sees how it runs on to the torch."""
    if place is None or read.setup.joint.type == "flat":
        return
    slope = place.seam.slope_y
    bend_mm = place.bends.range_mm(place.as_stated.values)
    # A seam that leaves its nominal line faster, mm/mm, or bends more, mm, is not straight up to the torch.
    if abs(slope) > 0.03 or bend_mm > 0.3:
        raise in_file(
            read.path,
            f"the seam leaves its nominal line by {slope:+.3f} mm/mm and bends by {bend_mm:.1f} mm where it "
            "is seen, and nobody sees how it runs on to the torch: take a straight seam along its nominal "
            "line, or a flat plate",
        )


def _refuse_other_causes(
    read: Recording, lit: Sequence[tuple[Frame, Float64]], place: StripePlace | None
) -> None:
    """Raise ArctrackError where sensor or optics spoil the arc's light: no arc would make up for that."""
    seam = NOMINAL_SEAM if place is None else place.seam
    try:
        seen = compare_arc(read.setup, lit, seam)
    except ValueError as error:
        raise in_file(read.path, str(error)) from None
    power, spread = seen.exposure_power, seen.spread
    if abs(power.value) > MAX_SIGMAS * math.hypot(power.sigma, EXPOSURE_SIGMA):
        raise in_file(
            read.path,
            f"the light goes with the exposure to the power {1.0 + power.value:.2f}, not 1: calibrate the "
            "sensor first",
        )
    if abs(spread.value) > MAX_SIGMAS * math.hypot(spread.sigma, SPREAD_SIGMA):
        raise in_file(
            read.path,
            f"{100.0 * spread.value:.1f} % of the light is spread over the image: clean window and lens, or "
            "let arctrack diagnose say what spreads it",
        )


def _place(read: Recording) -> StripePlace | None:
    """Return the stripes' place, None without any."""
    geometry = SensorGeometry.of(read.setup)
    frames, _ = parted(read.frames(chosen_rows(read)))
    sights = sights_of(geometry, looks_at(read, geometry, frames))
    return locate_stripes(read.setup, sights) if sights else None


def _part(place: StripePlace) -> PartPlacement:
    """Return the part's placement by stripes, with the camera within its tolerance."""
    cause = place.as_stated
    return PartPlacement.from_stripes(place.setup, place.middle_mm, cause.values, cause.fit)
