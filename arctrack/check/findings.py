"""Measurements in some frames against what the setup states, with a warning where they differ."""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from arctrack.check.look import CheckedFrame
from arctrack.check.seam_place import SeamPlace
from arctrack.check.sensor_seen import SensorReading, median
from arctrack.check.timing import Timing
from arctrack.recording.schema import keys_of
from arctrack.recording.setup_model import RecordingToml
from noise_model.compiled.arrays import Float64
from noise_model.effects import checked
from noise_model.instrument.sensor import saturation_dn
from noise_model.setup import Setup
from tracker import flags
from tracker.geometry import SEARCH_REACH_MM, SensorGeometry


def stated_contrast(setup: Setup, width_px: float) -> float:
    """Return the contrast of a stripe's brightness, relative, at a 1 sigma of its width; 0 for no speckle.

    The field's logarithm is a Gaussian's (`noise_model.effects`): pixels x apart correlate by

        rho = (exp(s^2 exp(-x^2 / 4 grain^2)) - 1) / C^2,  s^2 = ln(1 + C^2).

    A profile of sigma w averages 2 sqrt(pi) w pixels; their number over the sum of rho are independent, each
    with scatter C.
    """
    speckle = checked(setup.effects).get("laser_speckle")
    if speckle is None:
        return 0.0
    contrast, grain_px = speckle["contrast"], speckle["grain_px"]
    if contrast == 0.0 or not math.isfinite(width_px):
        return contrast
    reach = math.ceil(12.0 * grain_px)
    alike = float(likeness(np.arange(-reach, reach + 1.0), contrast, grain_px).sum())
    return contrast * min(1.0, math.sqrt(alike / (2.0 * math.sqrt(math.pi) * width_px)))


def likeness(apart_px: Float64, contrast: float, grain_px: float) -> Float64:
    """Return the correlation rho (...) of pixels that far apart."""
    rho = np.exp(-(apart_px**2) / (4.0 * grain_px**2))
    return np.asarray(np.expm1(math.log1p(contrast**2) * rho) / contrast**2)


FAR_MM = 3.0
"""A seam farther from its nominal line, in the median, comes near to where it is not looked for."""

MAX_COURSE_PX = 1.0
"""Largest distance of a stripe from its expected course."""

WIDTH_RATIO, PEAK_RATIO, ARC_RATIO, NOISE_RATIO = 1.15, 1.5, 2.0, 1.5
"""Largest ratio of a measured to the expected quantity, either way."""

MAX_SATURATED, MAX_SATURATED_PIXELS = 0.25, 0.5
"""Largest saturated share of a stripe's scan lines, and of a frame's pixels."""

SPECKLE_FROM, SPECKLE_RATIO = 0.05, 1.5
"""Least scatter of a stripe's brightness that counts as speckle, and its largest ratio to the stated one."""

BLACK_SIGMAS, BLACK_DN = 4.0, 0.3
"""Largest error of a black level: sigmas of its tolerance, and what rounding leaves."""

MIN_NOISE_DN = 0.4
"""Less noise is lost in the rounding to whole codes."""


@dataclass(frozen=True)
class SetupFinding:
    """A measured quantity: its name, what was measured and is stated, and the warning where these differ."""

    name: str
    text: str
    warning: str | None = None


def findings(
    setup: Setup,
    geometry: SensorGeometry,
    looks: Sequence[CheckedFrame],
    unlit: Sequence[CheckedFrame],
    sensor: SensorReading,
    exposures_fit: bool,
) -> list[SetupFinding]:
    """Compare measured and stated quantities; of a stripe only where a frame is valid.

    `unlit` are frames in which frames.csv has the laser off, examined as if it were on. Without exposures
    that fit no light does: then brightness is reported without a warning.
    """
    valid = [look for look in looks if look.track.valid]
    return [
        *_images(setup, looks),
        *_laser(looks, unlit),
        *_seam(geometry, valid),
        *_stripe(valid, exposures_fit),
        *_speckle(setup, valid),
        *_sensor(setup, sensor),
        *_arc(setup, looks, exposures_fit),
    ]


def _images(setup: Setup, looks: Sequence[CheckedFrame]) -> Iterator[SetupFinding]:
    """Yield the brightness of the frames."""
    if not looks:
        return
    clipped = saturation_dn(setup.sensor)
    brightest = max(int(look.frame.image_dn.max()) for look in looks)
    share = float(np.median([(look.frame.image_dn >= clipped).mean() for look in looks]))
    lost = sum(not look.shows_line for look in looks)
    warning = None
    if share > MAX_SATURATED_PIXELS:
        warning = f"{_percent(share)} of the pixels are saturated: nothing can be read; shorten the exposure"
    elif lost > 0.5 * len(looks):
        warning = f"{lost} of {len(looks)} frames show no line; is the laser on, the exposure long enough?"
    text = (
        f"brightest pixel {brightest} DN of {setup.sensor.max_dn}, {_percent(share)} of the pixels saturated"
    )
    yield SetupFinding("frames", text, warning)


def _laser(looks: Sequence[CheckedFrame], unlit: Sequence[CheckedFrame]) -> Iterator[SetupFinding]:
    """Yield whether the frames show the laser where frames.csv has it on, and only there.

    A frame with the laser off shows it where the tracker finds the stated joint in it. Frames with the laser
    on count only without arc, which may outshine a line, and only where other frames show that a line can be
    seen.
    """
    alone = [look for look in looks if not look.frame.arc_on]
    shown = [look.frame.index for look in unlit if look.track.valid]
    missed = [look.frame.index for look in alone if not (look.shows_line or look.track.valid)]
    if not (unlit or alone):
        return
    text = f"a stripe in {len(shown)} of {len(unlit)} frames with laser_on = 0"
    if alone:
        text += f", a line in {len(alone) - len(missed)} of {len(alone)} with laser_on = 1 and no arc"
    wrong = []
    if shown:
        wrong.append(f"{_frames(shown)} the stripe, though frames.csv says laser_on = 0")
    if missed and any(look.track.valid for look in (*looks, *unlit)):
        wrong.append(f"{_frames(missed)} no line, though frames.csv says laser_on = 1")
    cure = "correct frames.csv; are its rows those of the frames before or after?"
    yield SetupFinding("laser", text, f"{'; '.join(wrong)}; {cure}" if wrong else None)


def _frames(indices: Sequence[int]) -> str:
    """Return a sentence's beginning about some frames."""
    if len(indices) == 1:
        return f"frame {indices[0]} shows"
    return f"frames {', '.join(map(str, indices))} show"


def _seam(geometry: SensorGeometry, valid: Sequence[CheckedFrame]) -> Iterator[SetupFinding]:
    """Yield where the seam lies relative to its nominal line, and how the stripe runs there."""
    if not valid:
        return
    y_mm, z_mm = (median(look.seam_mm[axis] for look in valid) for axis in (0, 1))
    where = SeamPlace(y_mm, z_mm)
    far = max(abs(y_mm), abs(z_mm)) > FAR_MM
    cure = "correct [joint] seam_in_base_mm, or the poses' base frame"
    yield SetupFinding(
        "seam",
        f"{where}, in the median; sought within {SEARCH_REACH_MM:g} mm",
        f"the seam lies {where}, and is sought within {SEARCH_REACH_MM:g} mm; {cure}" if far else None,
    )
    course_px = median(look.course_px for look in valid)
    if math.isnan(course_px):
        return
    off = f"{course_px:.2g} px, {course_px / geometry.pixels_per_mm:.2g} mm,"
    warning = None
    if course_px > MAX_COURSE_PX:
        cure = "do [camera] fx, fy, pose_in_tool, [laser] plane_in_tool and the dimensions in [joint] hold?"
        warning = f"the stripe runs {off} off the course that the setup expects at this seam; {cure}"
    yield SetupFinding("course", f"the stripe runs {off} off its expected course", warning)


def _stripe(valid: Sequence[CheckedFrame], exposures_fit: bool) -> Iterator[SetupFinding]:
    """Yield the stripe's width, brightness and saturated share."""
    looks = _without_arc(valid)
    sigma_px = median(look.seen.sigma_px for look in looks)
    expected_px = median(float(np.median(look.placed.sigma_px)) for look in looks if look.placed is not None)
    if math.isfinite(sigma_px) and math.isfinite(expected_px):
        text = f"1 sigma {sigma_px:.3g} px, expected {expected_px:.3g} px"
        cure = "do [laser] stripe_sigma_mm, [camera] psf_sigma_px and fx, fy hold, and is the lens in focus?"
        parted = _part(sigma_px, expected_px, WIDTH_RATIO)
        yield SetupFinding("width", text, f"the stripe's width is {text}; {cure}" if parted else None)
    share = median(look.seen.saturated_share for look in looks)
    if share > 0.0:
        text = f"{_percent(share)} of the stripe's scan lines are saturated"
        cure = "shorten the exposure, or close the aperture"
        yield SetupFinding("saturation", text, f"{text}; {cure}" if share > MAX_SATURATED else None)
    peak_e = median(look.seen.peak_e for look in looks)
    predicted_e = median(look.peak_e for look in looks if math.isfinite(look.seen.peak_e))
    if math.isfinite(peak_e) and math.isfinite(predicted_e):
        text = f"{peak_e:.0f} e over its background, expected {predicted_e:.0f} e"
        cure = "do [laser] peak_e, [camera] exposure_s, [sensor] gain_e_per_dn and gamma hold?"
        parted = exposures_fit and share <= MAX_SATURATED and _part(peak_e, predicted_e, PEAK_RATIO)
        yield SetupFinding("peak", text, f"the stripe's peak is {text}; {cure}" if parted else None)


def _speckle(setup: Setup, valid: Sequence[CheckedFrame]) -> Iterator[SetupFinding]:
    """Yield the scatter of the stripe's brightness along it."""
    looks = _without_arc(valid)
    contrast = median(look.seen.contrast for look in looks)
    if math.isnan(contrast):
        return
    stated = stated_contrast(setup, median(look.seen.sigma_px for look in looks))
    if stated == 0.0:
        # The tracker learns what no setup states.
        yield SetupFinding("speckle", f"{contrast:.2f} from scan line to scan line, not stated", None)
        return
    text = f"{contrast:.2f} from scan line to scan line, [effects.laser_speckle] states {stated:.2f}"
    counts = max(contrast, stated) > SPECKLE_FROM
    cure = "leave it out, or let arctrack diagnose find contrast and grain_px"
    parted = counts and _part(contrast, stated, SPECKLE_RATIO)
    yield SetupFinding(
        "speckle", text, f"the stripe's brightness scatters by {text}; {cure}" if parted else None
    )


def _sensor(setup: Setup, sensor: SensorReading) -> Iterator[SetupFinding]:
    """Yield the level and noise of dark pixels."""
    if math.isnan(sensor.black_dn):
        return
    where = "in frames without laser and arc" if sensor.is_dark else "off the stripe"
    stated, tolerance_dn = setup.sensor, setup.tolerance.black_level_dn
    text = f"{sensor.black_dn:.1f} DN {where}, stated {stated.black_level_dn:g} ± {tolerance_dn:g} DN"
    off_dn = sensor.black_dn - stated.black_level_dn
    cure = "correct [sensor] black_level_dn" + ("" if off_dn < 0.0 else ", or keep other light out")
    parted = abs(off_dn) > BLACK_SIGMAS * tolerance_dn + BLACK_DN
    yield SetupFinding("black level", text, f"dark pixels read {text}; {cure}" if parted else None)
    if not stated.is_linear or not math.isfinite(sensor.noise_dn):
        return
    # Rounding to whole codes adds its twelfth.
    expected_dn = math.hypot(stated.read_noise_e / stated.gain_e_per_dn, math.sqrt(1.0 / 12.0))
    text = f"{sensor.noise_dn:.2f} DN {where}, expected {expected_dn:.2f} DN"
    counts = max(sensor.noise_dn, expected_dn) > MIN_NOISE_DN
    parted = counts and _part(sensor.noise_dn, expected_dn, NOISE_RATIO)
    cure = "do [sensor] read_noise_e and gain_e_per_dn hold?"
    yield SetupFinding("noise", text, f"dark pixels scatter by {text}; {cure}" if parted else None)


def _arc(setup: Setup, looks: Sequence[CheckedFrame], exposures_fit: bool) -> Iterator[SetupFinding]:
    """Yield the arc's brightness, from the frames whose light the map explains."""
    lit = [look for look in looks if look.frame.arc_on]
    if not lit:
        return
    if not setup.arc.shines:
        text = f"[arc] is missing, though frames.csv says arc_on in {len(lit)} of {len(looks)} frames"
        yield SetupFinding("arc", text, f"{text}; state it, or its light counts as the hall's")
        return
    dark = sum(bool(look.track.flags & flags.ARC_OFF.mask) for look in lit)
    unexplained = sum(bool(look.track.flags & flags.MAP_MISFIT.mask) for look in lit)
    level = median(look.track.arc_level for look in lit if not look.track.flags & flags.MAP_MISFIT.mask)
    light = f"{level:.2g} times the expected light" if math.isfinite(level) else "its light cannot be told"
    text = f"{light}, map_misfit in {unexplained} of {len(lit)} frames"
    warning = None
    if dark > 0.5 * len(lit):
        warning = f"{dark} of {len(lit)} frames show no arc light, though frames.csv says arc_on"
    elif exposures_fit and _part(level, 1.0, ARC_RATIO):
        cure = "do [arc] radiance_e, current_a and [camera] exposure_s hold?"
        warning = f"the arc's light is {level:.2g} times the expected; {cure}"
    yield SetupFinding("arc", text, warning)


def timing_findings(timing: Timing) -> Iterator[SetupFinding]:
    """Yield the rates of frames and poses, the tool's speed, and irregular times and exposures."""
    rates = f"frames at {timing.frame_rate_hz:.3g} Hz, poses at {timing.pose_rate_hz:.3g} Hz"
    yield SetupFinding("times", f"{rates}, the tool at {timing.speed_mm_s:.3g} mm/s")
    for warning in timing.warnings:
        yield SetupFinding("times", "", warning)


def _without_arc(looks: Sequence[CheckedFrame]) -> Sequence[CheckedFrame]:
    """Return the frames without arc, where the stripe is clearest, or all if all have one."""
    return [look for look in looks if not look.frame.arc_on] or looks


def _part(measured: float, expected: float, ratio: float) -> bool:
    """Return whether two numbers are more than a ratio apart."""
    return measured > ratio * expected or expected > ratio * measured


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def named_keys(texts: Iterable[str]) -> dict[str, str]:
    """Return what each key of a setup is that texts name as `[table] key, key`."""
    stated = {(key.table, key.name): key.explanation for key in keys_of(RecordingToml)}
    named = (
        (table, name)
        for text in texts
        for table, names in re.findall(r"\[([\w.]+)\] (\w+(?:(?:,| and|, and) \w+)*)", text)
        for name in re.split(r",? and |, ", names)
    )
    return {f"[{table}] {name}": stated[table, name] for table, name in named if (table, name) in stated}
