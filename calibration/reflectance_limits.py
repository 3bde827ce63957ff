"""Limits of goniometer readings: what they cannot determine, and why, one sentence each."""

import numpy as np

from calibration.goniometer import GreyResponse, Readings
from calibration.goniometer_test import RepeatScatter
from calibration.reflectance_model import C2, NAMES, ReadingsFit, ReadingsModel
from noise_model.compiled.arrays import Bool, Float64


def refuse_if_unfit(sample: Readings, response: GreyResponse) -> None:
    """Raise ValueError for readings that no fit can use."""
    settings = sample.settings
    angles = np.column_stack([settings.theta_i_deg, settings.theta_r_deg, settings.phi_r_deg])
    different = len(np.unique(angles, axis=0))
    if different < len(NAMES) or len(settings) <= len(NAMES):
        raise ValueError(
            f"readings at {different} different setting{'s' if different > 1 else ''} cannot determine "
            f"{', '.join(NAMES)} and their noise: it takes {len(NAMES) + 1} or more"
        )
    refuse_if_dark(sample, response)


def refuse_if_dark(readings: Readings, response: GreyResponse) -> None:
    """Raise ValueError if the readings, a sample's or a white standard's, are all black or one saturated."""
    brightest = float(np.max(readings.gray_level))
    if brightest >= response.saturation_dn:
        raise ValueError(f"a grey level of {brightest:g} is saturated (at {response.saturation_dn:g})")
    if brightest <= response.black_dn:
        raise ValueError(f"no reading is above black ({response.black_dn:g})")


def refuse_if_undetermined(
    sample: Readings,
    model: ReadingsModel,
    fitted: ReadingsFit,
    scatter: RepeatScatter,
    values: Float64,
    half: Float64,
) -> None:
    """Raise ValueError if kappa_diff, kappa_spec or c2, `values` (3,), has too wide an interval (-+ `half`).

    Raised, too, if the lobe shows at fewer than three settings, or the fit did not settle.
    """
    # A few settings may lie close to the fit by luck: their repeats say how close they can be expected to.
    why = _why_undetermined(sample, model, fitted, values, half * np.fmax(1.0, 1.0 / scatter.ratio))
    if why is None:
        return
    if scatter.is_unlikely:
        why += (
            f"; first see to gamma ({model.response.gamma:g}) and black ({model.response.black_dn:g}): "
            f"settings scatter {scatter.ratio:.1f} times as much about the fit as their repeats allow"
        )
    raise ValueError(why)


def _why_undetermined(
    sample: Readings, model: ReadingsModel, fitted: ReadingsFit, values: Float64, half: Float64
) -> str | None:
    alpha_deg = np.degrees(sample.settings.alpha)
    span = f"half angles of {alpha_deg.min():.1f} to {alpha_deg.max():.1f} deg"
    # Fewer than three settings could be a single bad reading.
    seen = int(np.sum(_lobe_over_noise(model, fitted)[: len(alpha_deg)] > 3.0))
    if seen < 3:
        return (
            f"kappa_spec and c2 are not determined: of {len(alpha_deg)} settings, with {span} to the normal, "
            f"{_at(seen)} the lobe out of the noise; add settings near the mirror direction, where it is 0"
        )
    wide = _too_wide(values, half)
    wide[2] |= C2 in fitted.fit.at_bounds
    if not (wide.any() or fitted.fit.converged):
        return "the fit did not settle: look at the readings for outliers"
    if not wide.any():
        return None
    names = [name for name, is_wide in zip(NAMES, wide, strict=True) if is_wide]
    verdict = f"{_listed(names)} not determined"
    if values[2] * np.radians(alpha_deg.max()) ** 2 < 1.0:
        return (
            f"{verdict}: all settings, with {span} to the normal, lie within the lobe; add settings away "
            "from the mirror direction"
        )
    return (
        f"{verdict}: {_intervals(names, values, half)}; add settings around the mirror direction or repeats"
    )


def _lobe_over_noise(model: ReadingsModel, fitted: ReadingsFit) -> Float64:
    """Return the lobe's part (m,) of each grey level, in its standard errors by the scatter."""
    p = fitted.fit.values
    without = p.copy()
    without[1] = 0.0
    scatter = np.sqrt(max(fitted.fit.chi2, np.finfo(float).tiny))
    return np.asarray((model.level(p) - model.level(without)) / (fitted.sigma * scatter))


def _too_wide(values: Float64, half: Float64) -> Bool:
    size = np.array([values[0] + values[1], values[1], values[2]])
    return np.asarray(~(half < 0.5 * size))


def _listed(names: list[str]) -> str:
    return f"{names[0]} is" if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]} are"


def _at(count: int) -> str:
    return "none shows" if count == 0 else "only 1 shows" if count == 1 else f"only {count} show"


def _intervals(names: list[str], values: Float64, half: Float64) -> str:
    texts = []
    for name in names:
        i = NAMES.index(name)
        texts.append(
            f"{name} = {values[i]:.3g} -+ {half[i]:.2g}" if np.isfinite(half[i]) else f"{name} is arbitrary"
        )
    return ", ".join(texts)
