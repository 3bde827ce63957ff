"""Sensor: from the light that arrives to digital numbers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from noise_model.compiled.arrays import Float64, Integers
from noise_model.condition import Condition
from noise_model.effects import drift
from noise_model.effects.compression import BEST_QUALITY, compressed, compressed_variance
from noise_model.effects.effect import ANY_FORM, UNSTATED, Draw, Effect, Stage, Values
from noise_model.effects.light import Light
from noise_model.fit import Parameter
from noise_model.instrument.sensor import Sensor
from noise_model.setup import Setup
from noise_model.view import View


def _exposure_drift(condition: Condition, values: Values) -> Condition:
    factor = drift.drifted(values, condition.timestamp_s)
    return replace(condition, exposure_s=condition.exposure_s * factor)


def _fixed_pattern(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    sigma = np.float32(values["sigma_rel"])
    if draw is None:
        light.variance_e2 = light.variance_e2 + (sigma * light.total) ** 2
        return
    camera = view.setup.camera
    # One chip, one pattern: the same in every frame.
    pattern = np.random.default_rng(20_261).standard_normal((camera.height, camera.width))
    light.scale(np.maximum(1.0 + sigma * pattern, 0.0).astype(np.float32))


def _blooming(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    if not view.is_frame:
        return
    well = np.float32(view.setup.sensor.full_well_e)
    excess = np.maximum(light.total - well, 0.0)
    if not excess.any():
        return
    # It takes most of a second to load; only those pay whose setup states the effect.
    from scipy.signal import lfilter

    columns = np.flatnonzero(excess.any(axis=0))
    fall = math.exp(-1.0 / values["reach_px"])
    # A recursive filter: each pixel hands on the share `fall` of what came to it and of its own excess.
    gain = 0.5 * values["spill"] * (1.0 - fall) / fall
    full = excess[:, columns].astype(np.float64)
    down = lfilter([0.0, gain * fall], [1.0, -fall], full, axis=0)
    up = lfilter([0.0, gain * fall], [1.0, -fall], full[::-1], axis=0)[::-1]
    evenly = values["column_share"] * full.mean(axis=0)
    spilled = light.other.copy()
    spilled[:, columns] += (down + up + evenly).astype(np.float32)
    light.other = spilled


def _gamma(setup: Setup, values: Values) -> Setup:
    sensor = setup.sensor
    return replace(setup, sensor=replace(sensor, gamma=sensor.gamma * values["gamma"], bend=values["bend"]))


def _black_level(setup: Setup, values: Values) -> Setup:
    sensor = setup.sensor
    return replace(setup, sensor=replace(sensor, black_level_dn=sensor.black_level_dn + values["offset_dn"]))


def _read_noise(setup: Setup, values: Values) -> Setup:
    sensor = setup.sensor
    return replace(setup, sensor=replace(sensor, read_noise_e=sensor.read_noise_e * values["noise_ratio"]))


def _compressed(image_dn: Integers, sensor: Sensor, values: Values) -> Integers:
    return compressed(image_dn, sensor, values["quality"])


def _compressed_variance(mean_dn: Float64, variance_dn2: Float64, sensor: Sensor, values: Values) -> Float64:
    return compressed_variance(mean_dn, variance_dn2, sensor, values["quality"])


EFFECTS = (
    Effect(
        id="exposure_drift",
        stage=Stage.SENSOR,
        summary="gain or exposure changes over the recording",
        equation="all charge x " + drift.EQUATION,
        source="a camera's automatic exposure or gain left on; black level and read noise stay",
        parameters=drift.PARAMETERS,
        typical={"rate_per_s": 0.2},
        condition=_exposure_drift,
        form_rel=UNSTATED,
    ),
    Effect(
        id="fixed_pattern",
        stage=Stage.SENSOR,
        summary="pixel gains differ (PRNU)",
        equation="variance += (sigma_rel charge)^2, the same numbers in every frame",
        source="EMVA 1288, photo response non-uniformity",
        parameters=(Parameter("sigma_rel", "", 0.0, 0.03, 0.0, 0.5, 0.0005),),
        typical={"sigma_rel": 0.05},
        image=_fixed_pattern,
    ),
    Effect(
        id="blooming",
        stage=Stage.SENSOR,
        summary="saturated pixels spill along columns",
        equation="of each pixel's charge beyond full well the share spill goes up and down its column, "
        "falling as exp(-distance / reach_px); what passes the image's rim is lost; the whole "
        "column glows by column_share of its mean charge beyond full well",
        source="Theuwissen 1995, Solid-State Imaging with Charge-Coupled Devices: a full well overflows into "
        "its column's neighbours, where the barriers are lowest, and columns that are read through a full "
        "well glow from rim to rim; the exponential is a form of our own",
        parameters=(
            Parameter("spill", "", 0.0, 0.4, 0.0, 1.0, 0.005),
            Parameter("reach_px", "px", 20.0, 15.0, 0.5, 400.0, 0.5),
            Parameter("column_share", "", 0.0, 0.4, 0.0, 1.0, 0.005),
        ),
        typical={"spill": 0.8, "reach_px": 30.0},
        image=_blooming,
        spreads=True,
    ),
    Effect(
        id="gamma",
        stage=Stage.SENSOR,
        summary="the response is not the stated power",
        equation="DN over black ~ y - bend y^2, y = (e / full well)^(gamma_stated x gamma)",
        source="Eq. 20; the bend is the next term of a response that is no power, such as that of a sensor "
        "which fills softly or has a knee",
        parameters=(
            Parameter("gamma", "", 1.0, 0.2, 0.2, 5.0, 0.002),
            Parameter("bend", "", 0.0, 0.2, -0.45, 0.45, 0.002),
        ),
        typical={"gamma": 0.7},
        setup=_gamma,
        form_rel=ANY_FORM,
    ),
    Effect(
        id="black_level",
        stage=Stage.SENSOR,
        summary="another offset",
        equation="black_level' = black_level + offset_dn",
        source="EMVA 1288, dark signal",
        parameters=(Parameter("offset_dn", "DN", 0.0, 5.0, -100.0, 1000.0, 0.02),),
        typical={"offset_dn": 8.0},
        setup=_black_level,
        form_rel=UNSTATED,
    ),
    Effect(
        id="read_noise",
        stage=Stage.SENSOR,
        summary="more noise than stated",
        equation="read_noise' = noise_ratio read_noise",
        source="EMVA 1288, temporal dark noise",
        parameters=(Parameter("noise_ratio", "", 1.0, 1.0, 0.05, 30.0, 0.01),),
        typical={"noise_ratio": 3.0},
        setup=_read_noise,
    ),
    Effect(
        id="image_compression",
        stage=Stage.SENSOR,
        summary="frames were kept as JPEG, or by a camera's own lossy code",
        equation="the cosine transform of each block of 8 x 8 pixels is rounded to whole steps. They are "
        "table K.1's, times 50 / quality below a quality of 50, times 2 - quality / 50 above. The variance "
        "is what rounding leaves of the mean and its noise",
        source="ITU-T T.81 (1992), the steps' scale after libjpeg; Fan and de Queiroz 2003 (IEEE Trans. "
        "Image Process. 12, 230): the steps show in an image that was compressed before",
        parameters=(Parameter("quality", "", BEST_QUALITY, 25.0, 1.0, BEST_QUALITY, 0.5),),
        typical={"quality": 60.0},
        codes=_compressed,
        codes_variance=_compressed_variance,
    ),
)
