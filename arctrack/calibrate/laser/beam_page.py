"""The light within the laser sheet on its calibration's page: origin, angle, thickness."""

import numpy as np

from arctrack.calibrate.page import PagePicture, ValueRow, row_of, with_sigma
from arctrack.report import style
from arctrack.report.embedded import svg
from calibration.laser.beam import Beam
from calibration.laser.fan import Fan, Missing
from calibration.laser.width import Law, Width
from noise_model.compiled.arrays import Float64

ANGLES, MIN_IN_BIN = 24, 10
"""Parts of the fan whose median shows how even it is, and the points that make one."""


def beam_rows(beam: Beam) -> tuple[ValueRow, ...]:
    """Return the values that were found."""
    rows = []
    if not isinstance(beam.fan, str):
        assert beam.covariance is not None
        sigma = np.sqrt(np.diag(beam.covariance))[5:8]
        for axis, value, each in zip("xyz", beam.origin_mm, sigma, strict=True):
            rows.append(row_of(f"origin, {axis}", f"origin_in_tool_mm, {axis}", value, each, "mm"))
        rows.append(
            row_of(
                "half angle of the fan", "fan_half_angle_deg", beam.fan.half_angle_deg, beam.fan.sigma[2], "°"
            )
        )
    if not isinstance(beam.width, str) and beam.width.at_height_mm is not None:
        value, error = beam.width.at_height_mm
        rows.append(row_of("thickness at tool height, 1 σ of half", "stripe_sigma_mm", value, error, "mm"))
    return tuple(rows)


def beam_sentences(beam: Beam) -> list[str]:
    """Return the determined properties of the sheet's light, and the missing measurements for the others."""
    lines = []
    if isinstance(beam.fan, str):
        lines.append(f"The fan's origin and angle are not determined: {beam.fan}. They stay as stated.")
        lines.append("The stated origin is moved into the plane.")
    else:
        lines += _of_fan(beam.fan)
    if isinstance(beam.width, str):
        lines.append(f"The sheet's thickness is not determined: {beam.width}. It stays as stated.")
    else:
        lines += _of_width(beam.width)
    return lines


def _of_fan(fan: Fan) -> list[str]:
    lines = [f"The stripe's ends lie {fan.residual_mm:.2f} mm off the two sides of the fan (RMS)."]
    # A fan that is turned by more than either is named.
    if abs(fan.turn_deg) > max(4.0 * fan.sigma[3], 1.0):
        turn, within = with_sigma(abs(fan.turn_deg), float(fan.sigma[3]))
        lines.append(
            f"The fan's middle is turned by {turn} ± {within}° in the sheet. A setup's fan is even about the "
            "steepest line: its ends are off by as much."
        )
    return lines


def _of_width(width: Width) -> list[str]:
    near, far = float(width.depth_mm.min()), float(width.depth_mm.max())
    lines = [f"From {near:.0f} to {far:.0f} mm below the origin the sheet's thickness goes {width.law}."]
    if width.law is not Law.MODEL:
        depths = np.array([near, 0.5 * (near + far), far])
        per_depth = width.at(depths) / depths
        off = 100.0 * float(np.abs(per_depth / per_depth[1] - 1.0).max())
        lines.append(f"A setup's sheet widens in proportion to the depth: at the ends it is {off:.0f} % off.")
    if width.at_height_mm is None:
        lines.append(
            "It is not followed to tool height, and stripe_sigma_mm stays as stated: add pairs with the "
            "board at tool height."
        )
    if width.waist is None:
        lines.append(
            "A waist is not determined: it takes pairs with the board where the stripe is thinnest, and "
            "nearer and farther than that."
        )
    else:
        waist = width.waist
        (depth, d), (sigma, s), (rayleigh, r) = (
            with_sigma(*pair) for pair in (waist.depth_mm, waist.sigma_mm, waist.rayleigh_mm)
        )
        lines.append(
            f"The waist lies {depth} ± {d} mm below the origin, its sigma is {sigma} ± {s} mm, the Rayleigh "
            f"range {rayleigh} ± {r} mm."
        )
    return lines


def beam_pictures(beam: Beam) -> tuple[PagePicture, ...]:
    """Return the pictures of fan, evenness and thickness, of what there is."""
    pictures = []
    if beam.pairs:
        pictures.append(
            PagePicture(
                _in_fan(beam),
                "the stripes and their ends within the sheet, and how even the light is over the fan",
                "The light is counted over the room's on the board, and over what the model has at that "
                "depth and angle: room light that is uneven shows as well.",
            )
        )
    if not isinstance(beam.width, str):
        pictures.append(
            PagePicture(
                _thickness(beam.width),
                "the sheet's thickness against the depth below the origin",
                "Bars are 1 σ of a pair. A beam is thinnest at its waist.",
            )
        )
    return tuple(pictures)


def _in_fan(beam: Beam) -> str:
    figure = style.new_figure(10.5, 4.2, "")
    sheet, even = figure.subplots(1, 2)
    style.plain(sheet, "across the fan [mm]", "below the stated origin [mm]", "within the sheet")
    style.plain(even, "angle in the fan [°]", "light over its median", "evenness")
    apex = np.zeros(2) if isinstance(beam.fan, str) else beam.fan.apex
    angles, levels = [], []
    for pair in beam.pairs:
        points = pair.points_mm[pair.is_lit]
        sheet.plot(points[:, 1], points[:, 0], ".", color=style.BLUE, markersize=1.5, rasterized=True)
        ends = np.array([end for end in pair.ends if not isinstance(end, Missing)]).reshape(-1, 2)
        sheet.plot(ends[:, 1], ends[:, 0], "o", color=style.VERMILLION, markersize=4)
        from_apex = pair.points_mm - apex
        angles.append(np.degrees(np.arctan2(from_apex[:, 1], from_apex[:, 0]))[pair.is_lit])
        levels.append(pair.level[pair.is_lit] / np.median(pair.level[pair.is_lit]))
    if not isinstance(beam.fan, str):
        deepest = max(float(pair.points_mm[:, 0].max()) for pair in beam.pairs)
        for sign in (-1.0, 1.0):
            slope = np.tan(np.radians(beam.fan.turn_deg + sign * beam.fan.half_angle_deg))
            reach = np.array([0.0, deepest - apex[0]])
            sheet.plot(apex[1] + slope * reach, apex[0] + reach, "-", color=style.BLACK, linewidth=0.8)
    sheet.invert_yaxis()
    angle, level = np.concatenate(angles), np.concatenate(levels)
    even.plot(angle, level, ".", color=style.SKY, markersize=1.5, rasterized=True)
    even.plot(*_medians(angle, level), "-", color=style.BLACK, linewidth=1.5)
    even.set_ylim(0.0, 2.5)
    return svg(figure)


def _medians(angle: Float64, level: Float64) -> tuple[Float64, Float64]:
    edges = np.linspace(angle.min(), angle.max(), ANGLES + 1)
    part = np.searchsorted(edges, angle).clip(1, ANGLES) - 1
    full = [n for n in range(ANGLES) if (part == n).sum() >= MIN_IN_BIN]
    middles = 0.5 * (edges[1:] + edges[:-1])
    return middles[full], np.array([np.median(level[part == n]) for n in full])


def _thickness(width: Width) -> str:
    figure = style.new_figure(7.0, 3.6, "")
    axes = style.plain(figure.add_subplot(), "below the origin [mm]", "1 σ of half the thickness [mm]")
    axes.errorbar(width.depth_mm, width.sigma_mm, width.error_mm, fmt="o", color=style.BLUE, markersize=4)
    margin = 0.1 * max(float(np.ptp(width.depth_mm)), 1.0)
    depth = np.linspace(width.depth_mm.min() - margin, width.depth_mm.max() + margin, 100)
    axes.plot(depth, width.at(depth), "-", color=style.BLACK, linewidth=1.0, label=str(width.law))
    axes.legend(fontsize=8)
    return svg(figure)
