"""Calibration of the laser sheet from recordings of its stripe on a flat plate, and its page."""

import math
from collections.abc import Sequence

import numpy as np

from arctrack.calibrate.gauge.page import off_picture
from arctrack.calibrate.gauge.record import robot_noise, sheet_records
from arctrack.calibrate.laser.page import plane_in_words, plane_rows
from arctrack.calibrate.page import CalibrationPage, PagePicture, row_of, with_reasons
from arctrack.calibrate.sheet.plate_frames import PlateFrames, read_plate_frames
from arctrack.calibrate.stage import CalibrationStage, Steps, Warn, left_out
from arctrack.errors import in_file
from arctrack.recording import Recording, SetupFile
from arctrack.report import style
from arctrack.report.embedded import svg
from calibration.camera.enough import UndeterminedError
from calibration.certificate import LATERAL, VERTICAL, Certificate
from calibration.gauge.plate import SHEET_PRIOR, WORDS, PlateCalibration, calibrate_by_plate

UNITS = ("deg", "deg", "mm")


def plate_page(result: PlateCalibration, certificate: Certificate, frames: PlateFrames) -> CalibrationPage:
    """Return the page's content."""
    robot_mm, form_mm = result.fitted.noise_mm.tolist()
    n = certificate.nearest_to_tool
    lateral_mm, vertical_mm = (certificate.sigma_mm[n, axis] for axis in (LATERAL, VERTICAL))
    shown = np.array([math.degrees(1.0), math.degrees(1.0), 1.0])
    rows = [
        row_of(f"sheet moved, {word}", "", value, sigma, unit)
        for word, value, sigma, unit in zip(
            WORDS, (shown * result.moved).tolist(), (shown * result.sigma).tolist(), UNITS, strict=True
        )
    ]
    prior = [f"{value:.2g} {unit}" for value, unit in zip(shown * SHEET_PRIOR, UNITS, strict=True)]
    sentences = [
        f"{len(result.problem.sightings)} frames of {frames.poses} poses. From pose to pose the stripe lies "
        f"{robot_mm:.3f} mm off the plate (1 σ): the robot's error. Along it {form_mm:.3f} mm are left.",
        f"Camera and sheet together place a seam point to {lateral_mm:.3f} mm lateral and "
        f"{vertical_mm:.3f} mm vertical in the tool (1 σ).",
        *(
            f"The plate does not tell the {word}: the {prior[WORDS.index(word)]} (1 σ) that are taken of any "
            "sheet before hardly get less."
            for word in result.untold
        ),
    ]
    if result.motions:
        sentences.append(
            f"To know the sheet better, add frames for which you {', and '.join(result.motions)}."
        )
    return CalibrationPage(
        title="arctrack corrects the laser sheet by a flat plate",
        label="laser plane",
        headline=plane_in_words(result.plane),
        sentences=tuple(sentences),
        rows=(*rows, *plane_rows(result.plane, result.covariance)),
        pictures=(
            PagePicture(_image(frames), "the stripe found in the first and the last frame"),
            off_picture(result.problem, result.fitted),
        ),
        mark="ambiguous" if result.untold else "no_gap",
        left_out=with_reasons(frames.left_out | result.left_out),
    )


def _image(frames: PlateFrames) -> str:
    lens = frames.lens
    figure = style.new_figure(10.5, 0.6 + 5.0 * lens.height / lens.width, "")
    for axes, n in zip(figure.subplots(1, 2), (0, -1), strict=True):
        low, high = np.percentile(frames.images[n], [1.0, 99.9])
        axes.imshow(frames.images[n], cmap="gray", vmin=low, vmax=max(high, low + 1.0))
        axes.plot(*frames.stripes[n].points_px.T, ".", color=style.SKY, markersize=1.5, rasterized=True)
        axes.set_axis_off()
    return svg(figure)


def sheet_stage(
    recordings: Sequence[Recording], stated: SetupFile, plate_mm: float | None, steps: Steps, warn: Warn
) -> CalibrationStage[PlateCalibration]:
    """Correct the laser sheet by a plate that stands still in base in all recordings.

    ArctrackError says why not, with the motion that is missing where the poses tell nothing of the sheet.
    """
    frames = read_plate_frames(recordings, stated.setup, steps("looking for the stripe", "frames"))
    warn(left_out(frames.left_out))
    robot_mm = robot_noise(stated).move_mm or None
    try:
        if frames.poses == 1:
            raise UndeterminedError("all frames are of one pose: raise, tilt or move the tool between them")
        result = calibrate_by_plate(stated.setup, frames.sightings, plate_mm, robot_mm)
    except UndeterminedError as error:
        raise in_file(recordings[0].path, f"{error}{_example(frames)}") from None
    warn(left_out(result.left_out))
    records, certificate = sheet_records(result, stated, "arctrack calibrate sheet")
    page = plate_page(result, certificate, frames)
    return CalibrationStage(result, page, records, bad_frames=frames.bad_frames)


def _example(frames: PlateFrames) -> str:
    """Return the reason of the first frame that is not used, for the end of a refusal."""
    reasons = {**frames.left_out, **{str(bad.path): bad.problem for bad in frames.bad_frames}}
    for name, reason in reasons.items():
        return f"; {len(reasons)} frames are left out, {name} {reason}"
    return ""
