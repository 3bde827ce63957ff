"""Results of `arctrack plan`, over the design space and along the robot's path: as CSV and as pictures."""

import csv
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from arctrack.errors import in_file
from arctrack.report import style
from noise_model.compiled.arrays import Float64
from noise_model.plan.design import clears_torch
from noise_model.plan.plan import Plan
from noise_model.plan.remedies import Cure
from noise_model.plan.search import DesignCandidate
from noise_model.surface.joint import corrugation_height, seam_frame, section
from noise_model.transforms import invert, transform

PLAN, PATH, PLAN_PICTURE, PATH_PICTURE = "plan.csv", "path.csv", "plan.png", "path.png"

DIGITS = 6

Row = Mapping[str, str | float]


def write_tables(plan: Plan, folder: Path) -> None:
    """Write both tables; ArctrackError if the folder cannot be written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_rows(folder / PLAN, designs(plan))
        write_rows(folder / PATH, stations(plan))
    except OSError as error:
        raise in_file(folder, f"cannot be written: {error.strerror}") from None


def designs(plan: Plan) -> list[Row]:
    """Return the user's design and those that none beats, a row each."""
    return [_design(plan.own, "yours"), *(_design(candidate, "front") for candidate in plan.front)]


def _design(candidate: DesignCandidate, kind: str) -> Row:
    design = candidate.design
    return {
        "design": kind,
        "sigma_mm": candidate.sigma_mm,
        "sigma_y_mm": candidate.sigma_y_mm,
        "sigma_z_mm": candidate.sigma_z_mm,
        "tilt_deg": design.tilt_deg,
        "azimuth_deg": design.azimuth_deg,
        "preview_mm": design.preview_mm,
        "stand_off_mm": design.stand_off_mm,
        "lean_deg": design.lean_deg,
        "filter_fwhm_nm": design.filter_fwhm_nm,
        "exposure_s": design.exposure_s,
        "triangulation_deg": design.triangulation_deg,
        "sigma_px": candidate.sigma_px,
        "arc_over_stripe": candidate.arc_over_stripe,
        "blind_share": candidate.blind_share,
        "saturated_share": candidate.saturated_share,
    }


def stations(plan: Plan) -> list[Row]:
    """Return the stations along the path, a row each, with what cures a blind one."""
    rows: list[Row] = []
    for n, (station_mm, noise) in enumerate(zip(plan.along.path.station_mm, plan.along.noise, strict=True)):
        cure = next((cure for cure in plan.cures if cure.first <= n <= cure.last), None)
        rows.append(
            {
                "station_mm": float(station_mm),
                "sigma_mm": noise.sigma_mm,
                "sigma_y_mm": noise.sigma_y_mm,
                "sigma_z_mm": noise.sigma_z_mm,
                "sigma_px": noise.sigma_px,
                "arc_over_stripe": noise.arc_over_stripe,
                "blind_share": noise.blind_share,
                "saturated_share": noise.saturated_share,
                "blind": float(cure is not None),
                **_cure(cure),
            }
        )
    return rows


def _cure(cure: Cure | None) -> Row:
    names = ("exposure_s", "lean_travel_deg", "lean_work_deg", "tilt_deg", "azimuth_deg")
    if cure is None:
        return {"cure_" + name: math.nan for name in (*names, *_CURED)}
    values = (
        cure.exposed.design.exposure_s,
        *cure.lean_deg,
        cure.moved.design.tilt_deg,
        cure.moved.design.azimuth_deg,
        *(getattr(cure, name.split("_", 1)[0]).sigma_mm for name in _CURED),
    )
    return {"cure_" + name: value for name, value in zip((*names, *_CURED), values, strict=True)}


_CURED = ("exposed_sigma_mm", "leaned_sigma_mm", "moved_sigma_mm")


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write rows of the same columns as CSV."""
    rows = list(rows)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(rows[0])
        for row in rows:
            writer.writerow(_text(value) for value in row.values())


def _text(value: str | float) -> str:
    """Return a cell: a number that is not known, or a sigma without end, is empty."""
    if isinstance(value, str):
        return value
    return f"{value:.{DIGITS}g}" if math.isfinite(value) else ""


COLOURS, UNKNOWN = "viridis", "#E8E8E8"


def draw_designs(plan: Plan, torch_radius_mm: float) -> Figure:
    """Return the page with the map over tilt and azimuth and the Pareto front."""
    own = plan.own.design
    figure = style.new_figure(
        15.0,
        5.0,
        f"{plan.setup.joint.type} in {plan.setup.material.name}: expected noise over sensor designs",
    )
    left, middle, right = figure.subplots(1, 3, gridspec_kw={"wspace": 0.08})
    here = f"preview {own.preview_mm:.0f} mm, stand-off {own.stand_off_mm:.0f} mm"
    _map(figure, left, plan, torch_radius_mm, "arc_over_stripe", "arc's light over the stripe's", here)
    _map(
        figure,
        middle,
        plan,
        torch_radius_mm,
        "sigma_mm",
        "seam's 1 σ [mm]",
        "same, what it makes of the seam",
    )
    _front(right, plan)
    return figure


def _map(
    figure: Figure, axes: Axes, plan: Plan, torch_radius_mm: float, name: str, label: str, title: str
) -> None:
    tilts, azimuths = (np.array(v) for v in (plan.noise_map.tilts_deg, plan.noise_map.azimuths_deg))
    values = plan.noise_map.grid(name)
    # Where the seam stays unknown on part of the path the light there is unknown too.
    values = np.where(np.isfinite(plan.noise_map.grid("sigma_mm")) & (values > 0.0), values, np.nan)
    style.plain(axes, "azimuth of the camera [deg], 0 ahead, 180 behind", "tilt [deg]", title)
    axes.grid(visible=False)
    axes.set_facecolor(UNKNOWN)
    if np.isfinite(values).any():
        mesh = axes.pcolormesh(
            azimuths, tilts, values, cmap=COLOURS, norm=_scale(values), shading="nearest", rasterized=True
        )
        _bar(figure, axes, mesh, label)
    blocked = [
        (c.design.azimuth_deg, c.design.tilt_deg)
        for c in plan.noise_map.candidates
        if not clears_torch(c.design, torch_radius_mm)
    ]
    if blocked:
        axes.plot(*np.array(blocked).T, "x", color="white", markersize=4, label="through the torch")
    own = plan.own.design
    axes.plot(own.azimuth_deg, own.tilt_deg, "o", color=style.VERMILLION, markersize=9, label="yours")
    handles = [*axes.get_legend_handles_labels()[0], Patch(facecolor=UNKNOWN, label="seam not shown")]
    axes.legend(handles=handles, fontsize=8, loc="upper right", facecolor="#BBBBBB")
    axes.set_xticks(np.linspace(azimuths[0], azimuths[-1], 5))


def _scale(values: Float64) -> LogNorm:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    middle = np.sqrt(low * high)
    # A colour scale spans at least this factor, so that what is all alike looks alike.
    half = max(np.sqrt(high / low), np.sqrt(2.0))
    return LogNorm(middle / half, middle * half)


def _bar(figure: Figure, axes: Axes, drawn: ScalarMappable, label: str) -> None:
    """Add a colour bar with plain numbers at 1, 2, 3 and 5 of each decade."""
    bar = figure.colorbar(drawn, ax=axes, label=label)
    bar.ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
    bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    bar.ax.yaxis.set_minor_formatter(NullFormatter())


def _front(axes: Axes, plan: Plan) -> None:
    style.plain(axes, "preview [mm]", "seam's 1 σ [mm]", "all designs (dots), Pareto front (diamonds)")
    known = [c for c in plan.judged if np.isfinite(c.sigma_mm)]
    colours = (style.BLUE, style.ORANGE, style.GREEN, style.SKY, style.GREY)
    stand_offs = sorted({c.design.stand_off_mm for c in plan.judged})
    for n, stand_off in enumerate(stand_offs):
        shift = 1.2 * (n - 0.5 * (len(stand_offs) - 1))
        colour = colours[n % len(colours)]
        some = [c for c in known if c.design.stand_off_mm == stand_off]
        axes.semilogy(*_places(some, shift), ".", color=colour, markersize=3, alpha=0.35)
        best = [c for c in plan.front if c.design.stand_off_mm == stand_off]
        axes.semilogy(
            *_places(best, shift),
            "D",
            color=colour,
            markersize=8,
            markeredgecolor=style.BLACK,
            label=f"stand-off {stand_off:.0f} mm",
        )
    if np.isfinite(plan.own.sigma_mm):
        axes.semilogy(*_places([plan.own], 0.0), "o", color=style.VERMILLION, markersize=9, label="yours")
    axes.axhline(plan.limit_mm, color=style.GREY, linewidth=1.0, linestyle="--", label="limit")
    axes.set_xlim(right=axes.get_xlim()[1] + 0.45 * np.ptp(axes.get_xlim()))
    axes.legend(fontsize=8, framealpha=0.9, loc="upper right")


def _places(candidates: list[DesignCandidate], shift: float) -> tuple[list[float], list[float]]:
    return [c.design.preview_mm + shift for c in candidates], [c.sigma_mm for c in candidates]


def draw_path(plan: Plan) -> Figure:
    """Return the page with the path coloured by the seam's sigma, and what goes with it at each station."""
    along = plan.along
    station, sigma = along.path.station_mm, along.column("sigma_mm")
    figure = style.new_figure(
        11.0, 7.5, f"{plan.setup.joint.type} in {plan.setup.material.name}: expected noise along the path"
    )
    grid = figure.add_gridspec(3, 1, height_ratios=(1.2, 1.0, 1.0))
    top = figure.add_subplot(grid[0])
    _coloured(figure, top, plan)
    light = figure.add_subplot(grid[1])
    style.plain(
        light, "station of the torch [mm]", "arc over stripe", "the arc's light over the stripe's peak"
    )
    light.plot(station, along.column("arc_over_stripe"), ".-", color=style.ORANGE, markersize=4)
    light.set_ylim(0.0, 1.15 * max(np.nanmax(along.column("arc_over_stripe"), initial=0.0), 1e-3))
    lines = figure.add_subplot(grid[2], sharex=light)
    style.plain(lines, "station of the torch [mm]", "share of scan lines", "scan lines that cannot be read")
    lines.fill_between(
        station, along.column("blind_share"), step="mid", color=style.SKY, alpha=0.6, label="any reason"
    )
    lines.plot(
        station, along.column("saturated_share"), ds="steps-mid", color=style.VERMILLION, label="saturated"
    )
    lines.set_ylim(-0.03, 1.03)
    lines.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, ncol=2)
    for axes in (light, lines):
        for cure in plan.cures:
            axes.axvspan(*_span(station, cure.first, cure.last), color=style.VERMILLION, alpha=0.12, lw=0)
    if not np.isfinite(sigma).any():
        top.text(0.5, 0.5, "the seam is not seen anywhere", transform=top.transAxes, ha="center")
    return figure


def _coloured(figure: Figure, axes: Axes, plan: Plan) -> None:
    """Draw the path as it is seen from above if it bends, else from the side, in the colours of sigma."""
    along, joint = plan.along, plan.setup.joint
    tips = along.path.T_base_tool[:, :3, 3]
    if len(joint.seam_in_base_mm) > 2:
        style.plain(axes, "base x [mm]", "base y [mm]", "the path from above")
        x, y = tips[:, 0], tips[:, 1]
        axes.set_aspect("equal", adjustable="datalim")
    else:
        style.plain(axes, "station of the torch [mm]", "height of the sheet [mm]", "the path from the side")
        x = along.path.station_mm
        y = corrugation_height(_joint_x(plan), section(joint).corrugation)
    sigma = along.column("sigma_mm")
    blind = ~(sigma <= plan.limit_mm)
    good = sigma[~blind]
    points = np.column_stack([x, y])
    if len(good):
        ways = np.stack([points[:-1], points[1:]], axis=1)
        drawn = LineCollection(list(ways), cmap=COLOURS, norm=_scale(good), linewidths=6, capstyle="round")
        drawn.set_array(np.where(blind[:-1] | blind[1:], np.nan, 0.5 * (sigma[:-1] + sigma[1:])))
        axes.add_collection(drawn)
        _bar(figure, axes, drawn, "seam's 1 σ [mm]")
    axes.plot(*points[blind].T, "x", color=style.VERMILLION, markersize=8, markeredgewidth=2)
    axes.autoscale_view()
    low, high = axes.get_ylim()
    if high - low < 1.0:
        axes.set_ylim(-2.0, 2.0)
    handles = [
        Line2D(
            [], [], color=style.VERMILLION, marker="x", linestyle="", label=f"blind: σ > {plan.limit_mm:g} mm"
        )
    ]
    axes.legend(handles=handles, fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)


def _joint_x(plan: Plan) -> Float64:
    """Return the tool's place along x of the joint frame (n,), mm."""
    T_base_joint = seam_frame(plan.setup.joint, np.asarray(plan.setup.joint.seam_in_base_mm[0]))
    return np.asarray(transform(invert(T_base_joint), plan.along.path.T_base_tool[:, :3, 3])[:, 0])


def _span(station: Float64, first: int, last: int) -> tuple[float, float]:
    half = 0.5 * float(np.median(np.diff(station))) if len(station) > 1 else 0.5
    return float(station[first]) - half, float(station[last]) + half
