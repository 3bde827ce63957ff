"""The arc's spectrum and the interference filter in front of the CCD.

A black body's continuum and the argon lines on it pass the filter; off axis the passband lies at shorter
wavelengths. All radiances are per unit of power, not of photons: over a passband that is the same within 1 %.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy import constants

from noise_model.compiled.arrays import Bool, Float64
from noise_model.instrument.argon import AR_I, REFERENCE_NM, SpectralLine, line_weights

if TYPE_CHECKING:
    from scipy.interpolate import PchipInterpolator

OPAQUE_DENSITY = 9.0
"""The optical density that stands for a transmission of 0."""

END_SHARE = 0.01
"""A curve covers its band if both ends have fallen to this share of its peak."""

MIN_TRANSMISSION = 1e-6
"""A laser of which less arrives does not pass."""

PROFILE_ANGLES = 64
"""Angles between which a filter's transmission is interpolated over the field."""

NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(8)
"""Gauss-Legendre nodes (8,) in each piece of a passband, from -1 to 1, and their weights (8,)."""

PIECES = 12
"""Pieces of a Gaussian's passband."""


@dataclass(frozen=True)
class Filter:
    """An interference filter as stated: a Gaussian passband of peak 1.

    What a real peak lacks belongs to the levels of arc and laser.

    Parameters
    ----------
    center_nm : float
        The passband's centre at normal incidence, nm.
    fwhm_nm : float
        Its full width at half maximum, nm.
    effective_index : float
        The effective refractive index, by which the passband shifts with the angle of incidence.

    Raises
    ------
    ValueError
        For a value out of its range; it names the key.
    """

    center_nm: float
    fwhm_nm: float
    effective_index: float

    def __post_init__(self) -> None:
        for name in ("center_nm", "fwhm_nm"):
            if not getattr(self, name) > 0:
                raise ValueError(f"[filter] {name} = {getattr(self, name)}: must be > 0")
        _check_index(self.effective_index)

    def at_normal(self, wavelength_nm: Float64) -> Float64:
        """Return the transmission (...,) at normal incidence."""
        return np.asarray(np.exp2(-(((wavelength_nm - self.center_nm) / (0.5 * self.fwhm_nm)) ** 2)))

    def edges_nm(self) -> Float64:
        """Return wavelengths between which the transmission is smooth; outside nothing passes."""
        # Half the width, in FWHM, over which a Gaussian is integrated: it has fallen to 1.5e-11 there.
        half = 3.0 * self.fwhm_nm
        return np.linspace(self.center_nm - half, self.center_nm + half, PIECES + 1)


class CurveError(ValueError):
    """A measured curve that cannot be a filter's; `sample` is the first wrong one, None if all of it is."""

    def __init__(self, problem: str, sample: int | None = None) -> None:
        super().__init__(problem)
        self.sample = sample


@dataclass(frozen=True, eq=False)
class FilterCurve:
    """An interference filter as measured at normal incidence.

    Between samples the optical density is interpolated by monotone cubics (Fritsch and Carlson 1980). The
    foot of an edge is nearly exponential, where straight lines in the transmission let too much through.
    Beyond its ends the curve passes nothing.

    Parameters
    ----------
    wavelength_nm : array (N,)
        Wavelengths, nm, rising.
    transmission : array (N,)
        Transmission at them, 0 to 1.
    effective_index : float
        The effective refractive index, by which the passband shifts with the angle of incidence.

    Raises
    ------
    CurveError
        A ValueError: for wavelengths that do not rise, a transmission below 0 or above 1, and a curve that
        does not cover its band.
    """

    wavelength_nm: Float64
    transmission: Float64
    effective_index: float

    def __post_init__(self) -> None:
        _check_index(self.effective_index)
        _check_curve(self.wavelength_nm, self.transmission)

    def at_normal(self, wavelength_nm: Float64) -> Float64:
        """Return the transmission (...,) at normal incidence."""
        density = self._density(np.clip(wavelength_nm, self.wavelength_nm[0], self.wavelength_nm[-1]))
        measured = (wavelength_nm >= self.wavelength_nm[0]) & (wavelength_nm <= self.wavelength_nm[-1])
        return np.where(measured & (density < OPAQUE_DENSITY), 10.0**-density, 0.0)

    def edges_nm(self) -> Float64:
        """Return wavelengths between which the transmission is smooth; outside nothing passes."""
        return self.wavelength_nm

    @property
    def center_nm(self) -> float:
        """The middle between the two wavelengths where half of the peak passes."""
        return float(np.mean(self._half_maximum_nm))

    @property
    def fwhm_nm(self) -> float:
        """Distance of the two wavelengths at which half of the peak passes."""
        return float(np.diff(self._half_maximum_nm)[0])

    @cached_property
    def _half_maximum_nm(self) -> tuple[float, float]:
        """The outermost wavelengths at which half of the highest sample passes."""
        from scipy.optimize import brentq

        # A sample at just half of the peak counts as above, whatever its logarithm is rounded to.
        half = 0.5 * (1.0 - 1e-9) * float(self.transmission.max())
        above = np.flatnonzero(self.transmission >= half)

        def over_half(wavelength_nm: float) -> float:
            return float(self.at_normal(np.asarray(wavelength_nm))) - half

        first, last = int(above[0]), int(above[-1])
        nm = self.wavelength_nm
        # A curve that covers its band passes less than half at both ends.
        return (
            float(brentq(over_half, nm[first - 1], nm[first])),
            float(brentq(over_half, nm[last], nm[last + 1])),
        )

    @cached_property
    def _density(self) -> PchipInterpolator:
        from scipy.interpolate import PchipInterpolator

        transmission = np.maximum(self.transmission, 10.0**-OPAQUE_DENSITY)
        return PchipInterpolator(self.wavelength_nm, -np.log10(transmission))


@dataclass(frozen=True)
class ArcSpectrum:
    """The arc's radiance over wavelength: a black body and argon lines on it, up to a common factor.

    `line_width_nm` is the equivalent width of Ar I 696.54 nm: how many nm of the neighbouring continuum carry
    as much power as the line. Pure argon at one atmosphere in local thermal equilibrium, optically thin, with
    Kramers' continuum times a Biberman factor of 1.7, gives 47 nm at 10 000 K, 24 nm at 12 000 K, 10 nm at
    16 000 K; self-absorption and metal vapour lower it. It is a parameter, to be found with two filters or
    from the fall-off over the field; the default is the middle of that range on a logarithmic scale.

    The hot core at the cathode exceeds 22 000 K (Kuehn, Koenemann and Kock 2007), the column is cooler. The
    shape over a passband hardly depends on either temperature.
    """

    continuum_temperature_k: float = 12_000.0
    excitation_temperature_k: float = 12_000.0
    line_width_nm: float = 20.0
    lines: tuple[SpectralLine, ...] = AR_I

    def __post_init__(self) -> None:
        for name in ("continuum_temperature_k", "excitation_temperature_k"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} = {getattr(self, name)}: must be > 0 and finite")
        if not 0 <= self.line_width_nm < np.inf:
            raise ValueError(f"line_width_nm = {self.line_width_nm}: must be >= 0 and finite")

    def continuum(self, wavelength_nm: npt.ArrayLike) -> Float64:
        """Return the continuum's spectral radiance (...,), W/(m^2 sr nm)."""
        return planck(wavelength_nm, self.continuum_temperature_k)

    def line_radiances(self) -> Float64:
        """Return each line's radiance (N,), W/(m^2 sr)."""
        reference = self.line_width_nm * float(self.continuum(REFERENCE_NM))
        return reference * line_weights(self.lines, self.excitation_temperature_k)


def planck(wavelength_nm: npt.ArrayLike, temperature_k: float) -> Float64:
    """Return a black body's spectral radiance (...,), W/(m^2 sr nm).

    B = 2 h c^2 / lambda^5 / (exp(h c / (lambda k T)) - 1) (Planck 1901), h, c, k as in CODATA.

    Raises ValueError for a wavelength or a temperature <= 0.
    """
    wavelength_m = 1e-9 * np.asarray(wavelength_nm, dtype=np.float64)
    if not (wavelength_m > 0).all():
        raise ValueError("a wavelength is > 0")
    if not 0 < temperature_k < np.inf:
        raise ValueError(f"temperature = {temperature_k} K: must be > 0 and finite")
    photon = constants.h * constants.c / (wavelength_m * constants.k * temperature_k)
    with np.errstate(over="ignore"):
        per_m = 2.0 * constants.h * constants.c**2 / wavelength_m**5 / np.expm1(photon)
    return np.asarray(1e-9 * per_m)


def angle_shift(theta: npt.ArrayLike, effective_index: float) -> Float64:
    """Return lambda_theta / lambda_0 (...,) of a filter that light meets at angles theta (...,), rad.

    sqrt(1 - sin^2(theta) / n_eff^2), n_eff of the layers' stack, 1.5 to 1.9 for most (Smith, Modern Optical
    Engineering, ch. 11). Makers hold it good up to 15 to 30 deg. The passband's shape is kept: that it
    widens, and that the two polarisations part, is left out.

    Raises ValueError for an angle of 90 deg or more.
    """
    theta = np.asarray(theta, dtype=np.float64)
    if not (np.abs(theta) < 0.5 * np.pi).all():
        raise ValueError("a filter is met at less than 90 deg")
    return np.asarray(np.sqrt(1.0 - (np.sin(theta) / effective_index) ** 2))


def transmission(
    optics: Filter | FilterCurve, wavelength_nm: npt.ArrayLike, theta: npt.ArrayLike = 0.0
) -> Float64:
    """Return T (...,) at wavelengths (...,), nm, met at angles theta (...,), rad, from the filter's normal.

    T_theta(lambda) = T_0(lambda / s), s = `angle_shift`: every feature at lambda_0 moves to s lambda_0. The
    arguments broadcast.
    """
    return optics.at_normal(np.asarray(wavelength_nm) / angle_shift(theta, optics.effective_index))


def laser_transmission(
    optics: Filter | FilterCurve, laser_wavelength_nm: float, theta: npt.ArrayLike
) -> Float64:
    """Return the laser line's transmission over the field angle, relative to that on the axis (...,).

    Raises ValueError for a laser that does not pass on the axis.
    """
    on_axis = float(transmission(optics, laser_wavelength_nm))
    if not on_axis > MIN_TRANSMISSION:
        raise ValueError(f"the filter does not pass the laser's {laser_wavelength_nm:g} nm")
    return transmission(optics, laser_wavelength_nm, theta) / on_axis


def passed_continuum(
    optics: Filter | FilterCurve, spectrum: ArcSpectrum, theta: npt.ArrayLike = 0.0
) -> Float64:
    """Return the continuum's radiance behind the filter (...,), W/(m^2 sr), at angles theta (...,), rad.

    The integral of B(lambda) T_theta(lambda) d lambda = s times that of B(s u) T_0(u) du, by Gauss-Legendre
    nodes between the wavelengths where T_0 changes its form: some hundred values for each angle. For a whole
    image see `over_field`.
    """
    edges = optics.edges_nm()
    half = 0.5 * np.diff(edges)
    u = (edges[:-1] + half)[:, np.newaxis] + half[:, np.newaxis] * NODES
    weight = half[:, np.newaxis] * NODE_WEIGHTS * optics.at_normal(u)
    s = angle_shift(theta, optics.effective_index)
    B = spectrum.continuum(s[..., np.newaxis] * u.ravel())
    return np.asarray(s * (B @ weight.ravel()))


def passed_lines(optics: Filter | FilterCurve, spectrum: ArcSpectrum, theta: npt.ArrayLike = 0.0) -> Float64:
    """Return the lines' radiance behind the filter (...,), W/(m^2 sr), at angles theta (...,), rad.

    The lines are taken as sharp: in such arcs they are narrower than a filter's edge by far.
    """
    wavelengths_nm = np.array([line.wavelength_nm for line in spectrum.lines])
    passing = transmission(optics, wavelengths_nm, np.asarray(theta)[..., np.newaxis])
    return np.asarray(passing @ spectrum.line_radiances())


def line_to_continuum(
    optics: Filter | FilterCurve, spectrum: ArcSpectrum, theta: npt.ArrayLike = 0.0
) -> Float64:
    """Return the ratio of line light to continuum behind the filter (...,)."""
    return passed_lines(optics, spectrum, theta) / passed_continuum(optics, spectrum, theta)


def over_field(of_angle: Callable[[Float64], Float64], theta: Float64) -> Float64:
    """Return a smooth function of the angle at theta (...,), rad, between `PROFILE_ANGLES` of its values."""
    profile = np.linspace(0.0, float(theta.max(initial=0.0)), PROFILE_ANGLES)
    return np.interp(theta, profile, of_angle(profile))


def _check_index(effective_index: float) -> None:
    if not effective_index >= 1:
        raise ValueError(f"[filter] effective_index = {effective_index}: must be >= 1")


def _check_curve(wavelength_nm: Float64, transmitted: Float64) -> None:
    if wavelength_nm.ndim != 1 or wavelength_nm.shape != transmitted.shape or len(wavelength_nm) < 3:
        raise CurveError("a filter's curve needs at least 3 samples of wavelength and transmission")
    _refuse(~(wavelength_nm > 0) | np.isinf(wavelength_nm), "wavelength {} nm: must be > 0", wavelength_nm)
    _refuse(~(transmitted >= 0), "transmission {}: must be >= 0", transmitted)
    _refuse(~(transmitted <= 1), "transmission {}: must be <= 1, an optical density >= 0", transmitted)
    falls = np.concatenate([[False], np.diff(wavelength_nm) <= 0])
    _refuse(falls, "wavelength {} nm does not come after the one before: they must rise", wavelength_nm)
    peak = float(transmitted.max())
    if not peak > 0:
        raise CurveError("the filter passes nothing")
    for sample in (0, len(transmitted) - 1):
        share = float(transmitted[sample]) / peak
        if share > END_SHARE:
            raise CurveError(
                f"the curve does not cover the band: at its end, {wavelength_nm[sample]:g} nm, "
                f"{100 * share:.2g} % of the peak still pass; it must fall to {100 * END_SHARE:g} %",
                sample,
            )


def _refuse(wrong: Bool, problem: str, values: Float64) -> None:
    if wrong.any():
        sample = int(np.argmax(wrong))
        raise CurveError(problem.format(f"{values[sample]:g}"), sample)
