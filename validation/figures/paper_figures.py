"""The paper's Figures 6 to 12, drawn: each with its geometry and the claim that it supports."""

from __future__ import annotations

import io
import re
import textwrap
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from arctrack.report import style
from noise_model.compiled.arrays import Float64
from validation.figures.paper_curves import (
    DISTANCE_MM,
    NEAREST_MM,
    RADIUS_MM,
    MirrorOverDistance,
    OffSpecular,
    OverAzimuth,
    OverDistance,
    OverViewingAngle,
    PaperFigure,
    agrees_from_mm,
    off_specular_peaks,
    point_error,
)

NAMES = {"mild_steel": "mild steel", "zn_coated": "Zn-coated panel", "sus304": "SUS304"}
WIDTH_INCH, HEIGHT_INCH = 8.4, 4.3
CAPTION_LETTERS = 138
COLOURS = 128

PLACE = f"Patch level with the arc's centre C, normal tilted towards the arc's top, R = {RADIUS_MM:g} mm"
TO_CENTRE = "θᵢ measured to C"
OPPOSITE = "view in the plane of incidence on the side opposite the arc"
ENDED_BY_G = {11: "; only the Zn coating's rise is ended by G, which falls below 1 there"}


def draw(curves: PaperFigure) -> Figure:
    """Return a figure, drawn for a page: two panels at most, its caption below."""
    if isinstance(curves, OverDistance):
        return _over_distance(curves)
    if isinstance(curves, MirrorOverDistance):
        return _mirror(curves)
    if isinstance(curves, OverAzimuth):
        return _over_azimuth(curves)
    return _off_specular(curves)


def write_png(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG of few colours: a third of the bytes, and nothing that the eye would miss."""
    full = io.BytesIO()
    figure.savefig(full, format="png")
    picture = Image.open(full).convert("RGB")
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


def write_csv(curves: PaperFigure, path: Path) -> None:
    """Write a figure's curves, a column each, six digits."""
    columns = curves.columns()
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, fmt="%.6g", delimiter=",", header=",".join(columns), comments="")


def _over_distance(curves: OverDistance) -> Figure:
    error = f"{100.0 * point_error(curves)[0]:+.0f} %".replace("-", "−")
    figure = _page(
        f"Figure {curves.number}: {NAMES[curves.material.name]}, {_angles(curves)}",
        f"{PLACE}; {TO_CENTRE}, {OPPOSITE}. Extended arc and point source agree far away and part near: "
        f"{error} at a = {NEAREST_MM:g} mm, {_agreement(curves)}.",
    )
    left, right = figure.subplots(1, 2)
    _two_falling(left, curves, "radiance", ("extended arc", "point source"))
    _error(right, curves)
    return figure


def _mirror(curves: MirrorOverDistance) -> Figure:
    figure = _page(
        f"Figure {curves.number}: SUS304, a mirror, {_angles(curves)}",
        f"{PLACE}; θᵢ measured to the middle of what the patch sees of the arc, view in the mirror "
        "direction. The two curves fall together only if the light on the whole mirror is what counts: "
        f"{_agreement(curves)}. A camera sees the arc's image in the mirror, which keeps its radiance at any "
        "distance.",
    )
    left, right = figure.subplots(1, 2)
    _two_falling(
        left,
        curves,
        "irradiance; radiance of the image",
        ("on the mirror, extended arc", "on the mirror, point source"),
    )
    left.plot(
        curves.a_mm,
        curves.image,
        color=style.GREEN,
        linewidth=1.8,
        label="radiance of the arc's image (ρL = 1)",
    )
    left.set_ylim(top=4.0)
    left.legend(fontsize=8, frameon=False, loc="lower left")
    _error(right, curves)
    return figure


def _over_azimuth(curves: OverAzimuth) -> Figure:
    aside = [float(np.interp(phi, curves.phi_r_deg, curves.extended)) for phi in (10.0, 30.0, 90.0)]
    figure = _page(
        f"Figure {curves.number}: {NAMES[curves.material.name]}, {_angles(curves)}, a = {DISTANCE_MM:g} mm",
        f"{PLACE}; {TO_CENTRE}; at φᵣ = 0 {OPPOSITE}. Noise falls out of that plane: under the extended "
        f"arc to {aside[0]:.2f} at 10°, {aside[1]:.2f} at 30° and {aside[2]:.2f} at 90°.",
    )
    axes = style.plain(figure.subplots(), "azimuth of the view φᵣ [deg]", "radiance, at φᵣ = 0 as 1")
    axes.plot(curves.phi_r_deg, curves.extended, color=style.BLUE, linewidth=1.8, label="extended arc")
    axes.plot(
        curves.phi_r_deg, curves.point, color=style.VERMILLION, dashes=(5, 2), lw=1.5, label="point source"
    )
    axes.set_xticks(np.arange(-90, 91, 30))
    axes.set_xlim(-90.0, 90.0)
    axes.set_ylim(0.0, 1.05)
    axes.legend(fontsize=9, frameon=False, loc="lower right" if aside[2] > 0.5 else "upper right")
    return figure


def _off_specular(curves: OffSpecular) -> Figure:
    theta_i = curves.theta_i_deg
    peaks = [off_specular_peaks(entry.material, theta_i) for entry in curves.of_materials]
    words = "; ".join(
        f"{NAMES[entry.material.name]} {entry.f_r_deg:.1f}° for fᵣ, {entry.extended_deg:.1f}° under the arc"
        for entry in peaks
    )
    figure = _page(
        f"Figure {curves.number}: off-specular peaks, θᵢ = {theta_i:g}°, a = {DISTANCE_MM:g} mm",
        f"{PLACE}; {TO_CENTRE}, {OPPOSITE}. Peaks: {words}. Without its 1/cos θᵣ the lobe peaks at the "
        f"mirror angle: that factor moves the peaks, not G{ENDED_BY_G.get(curves.number, '')}. The arc "
        "shines above C, here at a smaller angle of incidence, which moves the peaks back.",
    )
    for axes, entry in zip(figure.subplots(1, 2, sharey=True), curves.of_materials, strict=True):
        _viewing_angle(axes, curves.theta_r_deg, entry, theta_i)
    return figure


def _viewing_angle(axes: Axes, theta_r_deg: Float64, curves: OverViewingAngle, theta_i_deg: float) -> None:
    style.plain(axes, "viewing angle θᵣ [deg]", "over its own peak", NAMES[curves.material.name])
    axes.axvline(theta_i_deg, color=style.GREY, linewidth=0.8)
    axes.annotate(
        "mirror angle",
        (theta_i_deg, 0.02),
        xytext=(-3, 0),
        textcoords="offset points",
        rotation=90,
        ha="right",
        fontsize=8,
        color=style.GREY,
    )
    lines = (
        (curves.f_r, style.VERMILLION, (5, 2), "fᵣ alone"),
        (curves.lobe_flat, style.GREY, (1.5, 1.5), "fᵣ without 1/cos θᵣ"),
        (curves.extended, style.BLUE, (), "under the extended arc"),
    )
    for values, colour, dashes, label in lines:
        axes.plot(theta_r_deg, values, color=colour, dashes=dashes, linewidth=1.6, label=label)
        peak = int(values.argmax())
        axes.plot(theta_r_deg[peak], values[peak], "o", color=colour, markersize=4)
    axes.set_xlim(0.0, 90.0)
    axes.set_ylim(0.0, 1.06)
    axes.set_xticks(range(0, 91, 15))
    axes.legend(fontsize=8, frameon=False, loc="best")


def _two_falling(
    axes: Axes, curves: OverDistance | MirrorOverDistance, quantity: str, labels: tuple[str, str]
) -> None:
    style.plain(axes, "distance a [mm]", f"extended arc at {NEAREST_MM:g} mm = 1", f"normalised {quantity}")
    axes.loglog(curves.a_mm, curves.extended, color=style.BLUE, linewidth=1.8, label=labels[0])
    axes.loglog(
        curves.a_mm, curves.point, color=style.VERMILLION, dashes=(5, 2), linewidth=1.5, label=labels[1]
    )
    _millimetres(axes)
    axes.legend(fontsize=8, frameon=False, loc="lower left")


def _error(axes: Axes, curves: OverDistance | MirrorOverDistance) -> None:
    style.plain(axes, "distance a [mm]", "point / extended − 1 [%]", "error of the point source")
    axes.axhspan(-1.0, 1.0, color=style.GREEN, alpha=0.25, linewidth=0, label="±1 %")
    axes.semilogx(curves.a_mm, 100.0 * point_error(curves), color=style.BLACK, linewidth=1.6)
    _millimetres(axes)
    axes.legend(fontsize=8, frameon=False, loc="lower right")


def _millimetres(axes: Axes) -> None:
    axes.set_xticks([2.5, 5, 10, 20, 40, 60], ["2.5", "5", "10", "20", "40", "60"])
    axes.set_xticks([], minor=True)


def _page(title: str, caption: str) -> Figure:
    figure = style.new_figure(WIDTH_INCH, HEIGHT_INCH, title)
    figure.supxlabel(
        "\n".join(textwrap.wrap(_unbroken(caption), CAPTION_LETTERS)), x=0.01, ha="left", fontsize=8.5
    )
    return figure


def _unbroken(caption: str) -> str:
    """Keep numbers and their units on one line."""
    return re.sub(r"(?<=[\d=]) (?=[\d%m−])|(?<=[aR]) (?==)", "\N{NO-BREAK SPACE}", caption)


def _agreement(curves: OverDistance | MirrorOverDistance) -> str:
    tenth, hundredth = (agrees_from_mm(curves, tolerance) for tolerance in (0.1, 0.01))
    return f"within 10 % from a = {tenth:.1f} mm and within 1 % from {hundredth:.1f} mm on"


def _angles(curves: OverDistance | MirrorOverDistance | OverAzimuth) -> str:
    return f"θᵢ = {curves.theta_i_deg:g}°, θᵣ = {curves.theta_r_deg:g}°"
