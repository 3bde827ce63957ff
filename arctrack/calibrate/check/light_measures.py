"""The quantities of sensor, stripe and arc: how bright things are, how they scatter, how wide they look."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arctrack.calibrate.check.measure import LightStage, Measure, SetupVerdict, judged
from arctrack.check.look import CheckedFrame
from arctrack.check.sensor_seen import SensorReading, median
from calibration.check.arc_light import ArcLightCheck
from noise_model.setup import Setup

DARK_SIGMA_DN, NOISE_SIGMA_REL = 0.1, 0.1
"""1 sigma of a black level, DN, and of a noise, relative, from rounding and hot pixels."""

MIN_NOISE_DN = 0.4
"""Less noise is lost in the rounding to whole codes."""

SATURATED_SIGMA = 0.08
"""A stripe whose scan lines are saturated to three times this share cannot be judged."""

WIDTH_SIGMA_REL, PEAK_SIGMA_REL = 0.05, 0.1
"""1 sigma of a stripe's width and of its peak on metal, relative, in addition to the laser's tolerance."""

EXPOSURE_SIGMA, CURRENT_SIGMA, UNSTEADY_SIGMA, SHAPE_SIGMA, SPREAD_SIGMA = 0.03, 0.05, 0.01, 0.01, 0.007
"""1 sigma of the arc's quantities where all is as stated: powers, and relative."""

MAX_POWER_SIGMA, MAX_REL_SIGMA = 0.15, 0.05
"""Largest sigma of a determined power, and of a determined relative quantity."""


def sensor_measures(setup: Setup, seen: SensorReading, arc: ArcLightCheck | None) -> list[Measure]:
    """Return the sensor's: black level, noise in the dark, response to the exposure."""
    sensor, tolerance = setup.sensor, setup.tolerance
    where = "in dark frames" if seen.is_dark else "off the stripe"
    cure = "arctrack calibrate sensor" + (
        "" if seen.is_dark else "; other light may fall there: take dark frames"
    )
    black = judged(
        LightStage.SENSOR,
        f"black level {where}",
        seen.black_dn,
        sensor.black_level_dn,
        math.hypot(tolerance.black_level_dn, DARK_SIGMA_DN),
        "DN",
        cure,
    )
    if (
        not seen.is_dark
        and black.verdict is SetupVerdict.NOT_EXPLAINED
        and seen.black_dn > sensor.black_level_dn
    ):
        # Light of the hall lies over the black level.
        black = replace(black, verdict=SetupVerdict.UNTOLD)
    # Rounding to whole codes adds its twelfth.
    expected_dn = math.hypot(sensor.read_noise_e / sensor.gain_e_per_dn, math.sqrt(1.0 / 12.0))
    sigma_dn = expected_dn * math.hypot(tolerance.read_noise_rel, NOISE_SIGMA_REL)
    is_measurable = sensor.is_linear and max(seen.noise_dn, expected_dn) > MIN_NOISE_DN
    noise = judged(
        LightStage.SENSOR,
        f"noise {where}",
        seen.noise_dn,
        expected_dn,
        sigma_dn if is_measurable else math.nan,
        "DN",
        cure,
    )
    if not seen.is_dark and noise.verdict is SetupVerdict.NOT_EXPLAINED:
        # A codec smooths, and texture and light of the hall scatter.
        noise = replace(noise, verdict=SetupVerdict.UNTOLD)
    measures = [black, noise]
    if arc is not None and math.isfinite(arc.exposure_power.value):
        power = arc.exposure_power
        measures.append(
            judged(
                LightStage.SENSOR,
                "response to the exposure, power",
                1.0 + power.value,
                1.0,
                math.hypot(power.sigma, EXPOSURE_SIGMA) if power.sigma < MAX_POWER_SIGMA else math.nan,
                "",
                "arctrack calibrate sensor: [sensor] gamma, or exposure_s of frames.csv",
            )
        )
    return measures


def stripe_measures(setup: Setup, looks: Sequence[CheckedFrame], first: str) -> list[Measure]:
    """Return the stripe's saturation, width and peak, from frames without arc where there are some.

    Where an earlier stage, `first`, is wrong, a departing quantity counts as undetermined.
    """
    seen = [look for look in looks if not look.frame.arc_on] or list(looks)
    share = median(look.seen.saturated_share for look in seen)
    measures = [
        judged(
            LightStage.STRIPE,
            "scan lines saturated",
            share,
            0.0,
            SATURATED_SIGMA,
            "",
            "shorten the exposure or close the aperture, then check anew",
        )
    ]
    width_px = median(look.seen.sigma_px for look in seen)
    stripes = [look.placed or look.expected for look in seen]
    expected_px = median(float(np.median(stripe.sigma_px)) for stripe in stripes if stripe is not None)
    width = judged(
        LightStage.STRIPE,
        "width, 1 σ",
        width_px,
        expected_px,
        WIDTH_SIGMA_REL * expected_px,
        "px",
        "focus the lens; [laser] stripe_sigma_mm, [camera] psf_sigma_px",
    )
    ratio = median(look.seen.peak_e / look.peak_e for look in seen)
    peak = judged(
        LightStage.STRIPE,
        "peak over the expected one",
        ratio,
        1.0,
        math.hypot(setup.tolerance.laser_level_rel, PEAK_SIGMA_REL),
        "",
        "clean the window; [laser] peak_e, [material], exposure_s",
    )
    if measures[0].verdict is SetupVerdict.NOT_EXPLAINED:
        # What is left of a saturated stripe are its dim parts.
        width, peak = (replace(m, verdict=SetupVerdict.UNTOLD) for m in (width, peak))
    return [*measures, *(_after(measure, first) for measure in (width, peak))]


POWER = "power of the current"

ARC_QUANTITIES = (
    (
        "level over the expected one",
        "level",
        MAX_REL_SIGMA,
        "arctrack calibrate arc: [arc] radiance_e, center_in_tool_mm",
    ),
    (
        "unsteadiness from frame to frame",
        "unsteady",
        MAX_REL_SIGMA,
        "the tracker follows an unsteady arc; arctrack diagnose says how it flickers",
    ),
    (POWER, "current_power", MAX_POWER_SIGMA, "[arc] current_exponent, or current_a of frames.csv"),
    (
        "error of the map's shape",
        "shape",
        MAX_REL_SIGMA,
        "arctrack calibrate arc; arctrack diagnose names what the model lacks",
    ),
    (
        "light spread over the image, share",
        "spread",
        MAX_REL_SIGMA,
        "clean window and lens; arctrack diagnose: veiling_glare, or light between faces",
    ),
)
"""The arc's quantities: name, field of `ArcLightCheck`, largest sigma when determined, and the cure."""


def arc_measures(setup: Setup, arc: ArcLightCheck | None, first: str) -> list[Measure]:
    """Return the arc's quantities; departing ones are undetermined where an earlier stage, `first`, fails."""
    if arc is None:
        return []
    expected = {"level": 1.0, "current_power": setup.arc.current_exponent}
    own_sigma = {
        "level": setup.tolerance.arc_level_rel,
        "unsteady": UNSTEADY_SIGMA,
        "current_power": CURRENT_SIGMA,
        "shape": SHAPE_SIGMA,
        "spread": SPREAD_SIGMA,
    }
    measures = []
    for name, key, widest, cure in ARC_QUANTITIES:
        known = getattr(arc, key)
        if math.isnan(known.value):
            continue
        stated = expected.get(key, 0.0)
        value = known.value + stated if key == "current_power" else known.value
        sigma = math.hypot(known.sigma, own_sigma[key]) if known.sigma < widest else math.nan
        measure = judged(LightStage.ARC, name, value, stated, sigma, "", cure)
        measures.append(_after(measure, first))
    is_unsteady = any(m.name == ARC_QUANTITIES[1][0] and m.verdict is not SetupVerdict.OK for m in measures)
    # An unsteady arc at a few currents looks like another exponent.
    return [
        replace(m, verdict=SetupVerdict.UNTOLD) if is_unsteady and m.name == POWER else m for m in measures
    ]


def _after(measure: Measure, first: str) -> Measure:
    """Return a departing quantity as undetermined where an earlier stage must be corrected first."""
    if not first or measure.verdict is not SetupVerdict.NOT_EXPLAINED:
        return measure
    return replace(measure, verdict=SetupVerdict.UNTOLD, cure=f"first {first}, then check anew")
