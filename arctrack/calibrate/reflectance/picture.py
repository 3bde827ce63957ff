"""reflectance.png: the measured and the fitted reflectance, and what is left between them."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from arctrack.report import style
from calibration.goniometer import GreyResponse, Readings, Settings
from calibration.reflectance import Reflectance
from calibration.reflectance_model import NAMES
from noise_model.compiled.arrays import Bool, Float64

COLOURS = (style.BLUE, style.VERMILLION, style.GREEN, style.ORANGE, style.SKY, style.BLACK)
MARKERS = "osD^vP"

Sweep = tuple[float, float]


def draw(result: Reflectance, readings: Readings, response: GreyResponse) -> Figure:
    """Return the page for a result and the averaged readings that it came from."""
    figure = style.new_figure(11.0, 8.0, _title(result))
    grid = figure.add_gridspec(2, 2, height_ratios=(1.35, 1.0))
    settings = readings.settings
    sweeps = _sweeps(settings)
    _reflectance(figure.add_subplot(grid[0, :]), result, readings, response, sweeps)
    alpha_deg = np.degrees(settings.alpha)
    left = figure.add_subplot(grid[1, 0])
    _residuals(left, result, settings, sweeps, alpha_deg, "half angle α to the normal [deg]")
    right = figure.add_subplot(grid[1, 1], sharey=left)
    _residuals(right, result, settings, sweeps, result.predicted, "predicted grey level [DN]")
    return figure


def _title(result: Reflectance) -> str:
    values = zip(NAMES, result.values, result.sigmas, strict=True)
    return f"{result.material.name}: " + ", ".join(
        f"{name} {x:.4g} ± {sigma:.2g}" for name, x, sigma in values
    )


def _sweeps(settings: Settings) -> list[Sweep]:
    pairs, counts = np.unique(
        np.column_stack([settings.theta_i_deg, settings.phi_r_deg]), axis=0, return_counts=True
    )
    # Curves in the upper picture: the angles of incidence and azimuths with the most settings.
    chosen = np.sort(np.argsort(-counts, kind="stable")[:6])
    return [(float(theta_i), float(phi_r)) for theta_i, phi_r in pairs[chosen]]


def _reflectance(
    axes: Axes, result: Reflectance, readings: Readings, response: GreyResponse, sweeps: list[Sweep]
) -> None:
    settings = readings.settings
    unit = "1/sr" if result.absolute else "relative"
    style.plain(
        axes,
        "viewing angle θ_r [deg]",
        f"f_r [{unit}]",
        "reflectance: read, gamma undone (points, ±1 σ by the scatter), and fitted (lines)",
    )
    to_f_r = 1.0 / (result.scale * settings.irradiance)
    read = response.light(readings.gray_level) * to_f_r
    upper, lower = (response.light(readings.gray_level + sign * result.sigma) * to_f_r for sign in (1, -1))
    for n, sweep in enumerate(sweeps):
        which = _on(settings, sweep)
        theta_r = settings.theta_r_deg[which]
        errors = np.abs(np.stack([read - lower, upper - read]))[:, which]
        axes.errorbar(
            theta_r, read[which], errors, fmt=MARKERS[n], color=COLOURS[n], markersize=4, label=_label(sweep)
        )
        fine = np.linspace(theta_r.min(), theta_r.max(), 300)
        curve = Settings(np.full(300, sweep[0]), fine, np.full(300, sweep[1]), np.ones(300))
        axes.plot(fine, curve.light(result.material) / curve.irradiance, color=COLOURS[n], linewidth=1.2)
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=8, framealpha=0.8)


def _residuals(
    axes: Axes, result: Reflectance, settings: Settings, sweeps: list[Sweep], x: Float64, label: str
) -> None:
    style.plain(axes, label, "studentised residual", "read − fitted, in standard errors")
    axes.axhspan(-2.0, 2.0, color=style.GREY, alpha=0.12, lw=0)
    axes.axhline(0.0, color=style.BLACK, linewidth=0.8)
    drawn = np.zeros(len(settings), dtype=bool)
    for n, sweep in enumerate(sweeps):
        which = _on(settings, sweep)
        drawn |= which
        axes.plot(x[which], result.studentised[which], MARKERS[n], color=COLOURS[n], markersize=4)
    axes.plot(x[~drawn], result.studentised[~drawn], ".", color=style.GREY, markersize=4)


def _on(settings: Settings, sweep: Sweep) -> Bool:
    return np.asarray((settings.theta_i_deg == sweep[0]) & (settings.phi_r_deg == sweep[1]))


def _label(sweep: Sweep) -> str:
    theta_i, phi_r = sweep
    return f"θ_i = {theta_i:g}°" + (f", φ_r = {phi_r:g}°" if phi_r else "")
