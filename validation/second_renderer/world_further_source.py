"""Further forms of effects of source and illumination, which no judgement was tuned on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.constants import Boltzmann, elementary_charge
from scipy.ndimage import gaussian_filter
from scipy.special import voigt_profile
from scipy.stats import gamma, norm

from noise_model.compiled.arrays import Float64
from noise_model.instrument.spectrum import Filter, FilterCurve
from noise_model.setup import Setup
from validation.second_renderer.world_effect import (
    EffectForm,
    Generator,
    Moment,
    Values,
    WorldFrameLight,
    direction,
    drawn_seed,
    magnitude,
    signed,
)
from validation.second_renderer.world_laser import fan_deg, lit_by_hall
from validation.second_renderer.world_light import SheetProfile, TrueWorld
from validation.second_renderer.world_optics import ARC_K
from validation.second_renderer.world_source import filter_angle_shift, scale_arc_radius

ARGON_LINES = ((696.543, 3, 6.39e6, 13.3279), (706.722, 5, 3.80e6, 13.3022))
"""Ar I: wavelength, nm, the upper level's weight, the rate, 1/s, and the upper level, eV (NIST ASD)."""


def _draw_wear(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"height_mm": magnitude(strength, 0.25, 3.0)}


def _wear(moment: Moment, p: Values) -> Moment:
    x, y, z = moment.arc_shift_mm
    worn = math.sqrt(max(moment.time_s, 0.0) / moment.duration_s)
    return replace(moment, arc_shift_mm=(x, y, z + p["height_mm"] * worn))


def _draw_sway(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    x, y = direction(draw, magnitude(strength, 0.3, 2.5))
    hz, phase = draw.uniform(0.5, 5.0), draw.uniform(0.0, 2.0 * math.pi)
    return {"x_mm": x, "y_mm": y, "frequency_hz": hz, "phase_rad": phase}


def _sway(moment: Moment, p: Values) -> Moment:
    x, y, z = moment.arc_shift_mm
    blown = 0.7 + math.sin(2.0 * math.pi * p["frequency_hz"] * moment.time_s + p["phase_rad"])
    return replace(moment, arc_shift_mm=(x + blown * p["x_mm"], y + blown * p["y_mm"], z))


def _draw_spheroid(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"radius_ratio": math.exp(signed(draw, magnitude(strength, 0.2, 0.6)))}


def _spheroid(world: TrueWorld, p: Values) -> TrueWorld:
    return replace(scale_arc_radius(world, p), arc_height_ratio=world.arc_height_ratio / p["radius_ratio"])


def _draw_ripple(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    hz = 100.0 if draw.random() < 0.5 else 120.0
    return {"amplitude": magnitude(strength, 0.035, 0.6), "frequency_hz": hz, "seed": drawn_seed(draw)}


def _ripple(moment: Moment, p: Values) -> Moment:
    # The frames' clock is not the mains': each frame begins at another phase.
    phase = np.random.default_rng([int(p["seed"]), moment.index]).uniform(0.0, 2.0 * math.pi)
    kept = float(np.sinc(p["frequency_hz"] * moment.exposure_s))
    return replace(moment, arc_level=moment.arc_level * (1.0 + p["amplitude"] * kept * math.sin(phase)))


def two_cavity(stated: Filter | FilterCurve, wavelength_nm: Float64) -> Float64:
    """Return the transmission of a filter of two cavities, flatter and steeper than a Gaussian."""
    return np.asarray(1.0 / (1.0 + (2.0 * (wavelength_nm - stated.center_nm) / stated.fwhm_nm) ** 4))


def _draw_lines(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"on_axis": magnitude(strength, 0.06, 0.8)}


def _argon_lines(frame: WorldFrameLight, p: Values) -> None:
    stated, shift = frame.studio.world.setup.stated_filter, filter_angle_shift(frame)
    passed, on_axis = np.zeros(frame.sight.shape), 0.0
    for nm, weight, rate, upper_ev in ARGON_LINES:
        emitted = weight * rate / nm * math.exp(-upper_ev * elementary_charge / (Boltzmann * ARC_K))
        passed += emitted * two_cavity(stated, nm * shift)
        on_axis += emitted * float(two_cavity(stated, np.array(nm)))
    frame.arc = frame.arc * (1.0 + p["on_axis"] * passed / on_axis)


MIN_STAY_S = 0.3
"""A mode stays so long or longer: three frames or more show it."""


def _draw_telegraph(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    jump = signed(draw, magnitude(strength, 0.07, 0.35))
    # The first hop is one that the recording shows.
    at_s = draw.uniform(0.4, 1.2)
    return {"jump": jump, "at_s": at_s, "hops_per_s": draw.uniform(0.8, 3.0), "seed": drawn_seed(draw)}


def _telegraph(moment: Moment, p: Values) -> Moment:
    waits_s = np.random.default_rng(int(p["seed"])).exponential(1.0 / p["hops_per_s"], 50)
    hops_s = p["at_s"] + np.concatenate([[0.0], np.cumsum(MIN_STAY_S + waits_s)])
    is_up = bool(np.searchsorted(hops_s, moment.time_s, side="right") % 2)
    return replace(moment, laser_level=moment.laser_level * (1.0 + p["jump"] * is_up))


def _draw_integrated(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    long_px, short_px = draw.uniform(1.2, 2.5), draw.uniform(0.4, 0.8)
    along, across = (long_px, short_px) if draw.random() < 0.5 else (short_px, long_px)
    return {"contrast": magnitude(strength, 0.06, 0.35), "along_px": along, "across_px": across}


def _integrated(frame: WorldFrameLight, p: Values) -> None:
    field = gaussian_filter(
        frame.draw.standard_normal(frame.laser.shape), (p["across_px"], p["along_px"]), mode="wrap"
    )
    looks = p["contrast"] ** -2.0
    frame.laser = frame.laser * gamma.ppf(norm.cdf(field / field.std()), looks, scale=1.0 / looks)


def _draw_powell(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"ears": magnitude(strength, 0.1, 1.2), "half_deg": draw.uniform(7.0, 10.0), "aside_deg": 0.0}


def _powell(frame: WorldFrameLight, p: Values) -> None:
    off = np.abs(fan_deg(frame)) / p["half_deg"]
    # Brighter towards its ends, beyond which it falls within a tenth of the half angle.
    ended = 1.0 / (1.0 + np.exp((off - 1.0) / 0.03))
    frame.laser = frame.laser * (1.0 + p["ears"] * np.minimum(off, 1.0) ** 2) * ended


@dataclass(frozen=True)
class VoigtSheet(SheetProfile):
    """A Gaussian sheet with a Lorentzian's tails, of half width `lorentz` in the Gaussian's sigmas."""

    lorentz: float = 0.0

    def at(self, across: Float64) -> Float64:
        """Return the irradiance (n,) at distances (n,), sigmas, over that in the middle."""
        return np.asarray(voigt_profile(across, 1.0, self.lorentz) / voigt_profile(0.0, 1.0, self.lorentz))

    @property
    def reach(self) -> float:
        """How far from the middle the sheet is rendered, sigmas."""
        return 40.0


def _draw_voigt(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"lorentz": magnitude(strength, 0.1, 0.7)}


def _voigt(world: TrueWorld, p: Values) -> TrueWorld:
    return replace(world, profile=VoigtSheet(lorentz=p["lorentz"]))


def _draw_near_lamp(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {
        "level_e": magnitude(strength, 250.0, 5000.0),
        "x_mm": draw.uniform(-150.0, 200.0),
        "y_mm": signed(draw, draw.uniform(60.0, 200.0)),
        "z_mm": draw.uniform(150.0, 400.0),
        "texture": draw.uniform(0.0, 0.08),
        "seed": drawn_seed(draw),
    }


def _near_lamp(frame: WorldFrameLight, p: Values) -> None:
    lamp = np.array([p["x_mm"], p["y_mm"], p["z_mm"]])
    way = lamp - np.nan_to_num(frame.sight.points)
    square = np.sum(way**2, axis=1)
    cos_i = np.sum(way * np.nan_to_num(frame.sight.normals), axis=1) / np.sqrt(square)
    # Over what a level plate below the tool, 36 mm ahead, gets of it.
    to_middle = lamp - [36.0, 0.0, 0.0]
    middle = to_middle[2] / float(np.sum(to_middle**2)) ** 1.5
    lit_by_hall(frame, p["level_e"] * np.maximum(cos_i, 0.0) / square / middle, p["texture"], int(p["seed"]))


FORMS: Mapping[str, EffectForm] = {
    "arc_length": EffectForm(
        "wear",
        "center_z + height_mm sqrt(t / T): the electrode wears, fast at first (Sadek, Ushio and Matsuda "
        "1990, Metall. Trans. A 21, 3221)",
        _draw_wear,
        moment=_wear,
    ),
    "arc_deflection": EffectForm(
        "sway",
        "center + (x_mm, y_mm) (0.7 + sin(2 pi f t + phase)): a magnetic field that alternates (Hicken and "
        "Jackson 1966, Weld. J. 45, 515s)",
        _draw_sway,
        moment=_sway,
    ),
    "arc_radius": EffectForm(
        "spheroid",
        "radius x radius_ratio, its height unchanged: a bell of another width (Hsu, Etemadi and Pfender "
        "1983, J. Appl. Phys. 54, 1293)",
        _draw_spheroid,
        world=_spheroid,
    ),
    "arc_flicker": EffectForm(
        "ripple",
        "arc x (1 + amplitude sinc(f exposure) sin(phase)), f twice the mains', phase even in each frame: a "
        "rectifier's ripple (Mohan, Undeland and Robbins, Power Electronics)",
        _draw_ripple,
        moment=_ripple,
    ),
    "argon_line_leak": EffectForm(
        "lines",
        "arc x (1 + on_axis sum I T(l, theta) / sum I T(l, 0)), l = 696.5 and 706.7 nm, I = g A / l "
        "exp(-E / k 12000 K), T = 1 / (1 + (2 (l - l0) / fwhm)^4): two cavities (Macleod, Thin-Film Optical "
        "Filters)",
        _draw_lines,
        image=_argon_lines,
    ),
    "laser_power_drift": EffectForm(
        "telegraph",
        "laser x (1 + jump) from at_s on, off and on again after exponential times: a diode hops between "
        "two modes (Heumier and Carlsten, ILX Lightwave application note 8)",
        _draw_telegraph,
        moment=_telegraph,
    ),
    "laser_speckle": EffectForm(
        "integrated",
        "laser x gamma-distributed grains of contrast^-2 degrees of freedom, along_px x across_px large "
        "(Goodman 2007, Speckle Phenomena in Optics, ch. 4: integrated speckle)",
        _draw_integrated,
        image=_integrated,
    ),
    "uneven_fan": EffectForm(
        "powell",
        "laser x (1 + ears (phi / half_deg)^2), ending about half_deg: a Powell lens (US patent 4826299)",
        _draw_powell,
        light=_powell,
    ),
    "stripe_profile": EffectForm(
        "voigt",
        "Voigt's profile, Lorentzian half width lorentz sigma: light that the line lens scatters (Olivero "
        "and Longbothum 1977, J. Quant. Spectrosc. Radiat. Transf. 17, 233)",
        _draw_voigt,
        world=_voigt,
    ),
    "ambient_light": EffectForm(
        "near_lamp",
        "other + level_e cos^4 cos(theta_i) / r^2 x (1 + texture blotches), r from a lamp beside the part: "
        "the inverse-square law (Lambert 1760, Photometria)",
        _draw_near_lamp,
        light=_near_lamp,
        in_dark=True,
    ),
}
