"""Calibration of arc and metal from a recording with the arc on."""

import math
from collections.abc import Sequence

from arctrack.calibrate.arc.page import arc_page
from arctrack.calibrate.arc.record import arc_records
from arctrack.calibrate.check.check_setup import sights_of
from arctrack.calibrate.check.light_measures import EXPOSURE_SIGMA, SPREAD_SIGMA
from arctrack.calibrate.check.measure import MAX_SIGMAS
from arctrack.calibrate.stage import CalibrationStage, Steps
from arctrack.check.check_recording import parted
from arctrack.check.check_sample import case_of, chosen_rows
from arctrack.check.explanations import explains_as_stated, explanations
from arctrack.check.look import looks_at
from arctrack.errors import in_file
from arctrack.recording import Recording
from calibration.arc.calibrate import ArcCalibration, calibrate_arc
from calibration.arc.problem import PartPlacement
from calibration.check.arc_light import compare_arc
from calibration.check.stripe_place import StripePlace, locate_stripes
from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import NOMINAL_SEAM
from tracker.geometry import SensorGeometry
from tracker.state import Frame


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
