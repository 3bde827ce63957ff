"""calibrate_laser.html: the laser sheet's plane in words and pictures."""

import math

import numpy as np

from arctrack.calibrate.laser.laser_pairs import LaserPairs
from arctrack.calibrate.laser.record import PARAMETERS
from arctrack.calibrate.page import (
    EXACT_LENS,
    HALF_95,
    CalibrationPage,
    PagePicture,
    ValueRow,
    row_of,
    with_reasons,
    with_sigma,
)
from arctrack.report import style
from arctrack.report.embedded import svg
from calibration.laser.beam import Beam
from calibration.laser.calibrate import LaserCalibration, off_sheet_mm
from calibration.laser.fan import Fan, Missing
from calibration.laser.width import Law, Width
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup

WORDS = ("normal, x", "normal, y", "normal, z", "distance, d")
BINS, MIN_IN_BIN = 30, 20
"""Parts of the stripe whose mean shows the sheet's bow, and the points that make a mean."""


def laser_page(result: LaserCalibration, pairs: LaserPairs, beam: Beam, setup: Setup) -> CalibrationPage:
    """Return the page's content."""
    points = np.concatenate(result.points_mm)
    middle = points.mean(axis=0, keepdims=True)
    sigma_mm = float(result.distance_sigma_mm(middle)[0])
    row = np.append(middle, 1.0)
    pairs_mm = math.sqrt(float(row @ result.own_covariance[:4, :4] @ row))
    depth = points[:, 2]
    tilt_deg = math.degrees(result.fit.tilt_sigma * math.sqrt(result.scatter))
    plane, bow, covariance = result.in_tool(setup.camera.T_tool_camera, setup.laser.plane)
    sentences = [
        f"{len(result.names)} pairs, {len(points)} points from {depth.min():.0f} to {depth.max():.0f} mm of "
        f"depth lie {result.rms_mm:.3f} mm off the sheet (RMS).",
        f"Along its normal the plane is known to {sigma_mm:.3f} mm amid the points, 1 σ: {pairs_mm:.3f} mm "
        f"from the pairs, the rest from the lens. Its lean about the stripes is known to {tilt_deg:.3f}°.",
        f"It is turned by {turned_deg(plane, setup):.2f}° against the plane stated before.",
    ]
    sentences.append(_bow_sentence(result))
    if result.scatter > 1.0:
        sentences.append(
            f"Pairs differ {math.sqrt(result.scatter):.1f} times as much as their noise predicts, and sigmas "
            "are as much wider."
        )
    sentences += beam_sentences(beam)
    notes = [
        "The plane in the tool frame rests on the setup's pose of the camera, which counts as exact here."
    ]
    if pairs.lens_covariance is None:
        notes.append(EXACT_LENS)
    if pairs.lit:
        most = 100.0 * max(pairs.lit.values())
        notes.append(
            f"{len(pairs.lit)} images show board and stripe at once. The board's own picture is taken off "
            f"them, and up to {most:.1f} % of its contrast is left (1 σ)."
        )
    return CalibrationPage(
        title="arctrack calibrates the laser sheet",
        label="laser plane",
        headline=plane_in_words(plane),
        sentences=tuple(sentences),
        rows=(*plane_rows(plane, covariance[:4, :4]), *_bow_rows(bow, covariance[4, 4]), *beam_rows(beam)),
        pictures=(
            PagePicture(
                _in_plane(result),
                "the points within the plane, a colour for each pair; lines are the stripes' fitted ones",
                "The farther the stripes lie apart, the better the sheet's lean is known.",
            ),
            PagePicture(
                _residuals(result),
                "how far points are off the sheet, along the stripe and pair by pair",
                "What all pairs share along the stripe is a sheet that is no cone, or a lens that is not "
                "right. Bars are 1 σ of each pair's ends.",
            ),
            PagePicture(
                _image(result, pairs),
                "where stripes and corners were seen, over the first image with the laser",
                "",
            ),
            *beam_pictures(beam),
        ),
        notes=tuple(notes),
        mark="no_gap" if result.scatter == 1.0 else "ambiguous",
        left_out=with_reasons(pairs.left_out | result.left_out),
    )


def _bow_sentence(result: LaserCalibration) -> str:
    """Return what the boards say of the sheet's bow."""
    bow = result.bow
    if bow is None:
        return "The pairs do not tell a bowed sheet from a plane: more of them are needed."
    size, within = with_sigma(abs(bow.value) * result.ends_mm, bow.sigma * result.ends_mm)
    flat_mm, bowed_mm = bow.held_out_mm
    errors = (
        f"a board that is held out lies {bowed_mm:.3f} mm off the bowed sheet of the others, and "
        f"{flat_mm:.3f} mm off their plane (RMS)"
    )
    where = f"{result.half_mm:.0f} mm to either side its ends lie {size} ± {within} mm off its middle"
    if bow.is_taken:
        return f"The sheet is bowed: {where}. {errors[0].upper()}{errors[1:]}."
    return f"The sheet counts as a plane. With a bow {where}: {errors}."


def _bow_rows(bow: float, variance: float) -> tuple[ValueRow, ...]:
    return (row_of("bow off the plane", "bow", bow, math.sqrt(variance), ""),) if bow else ()


def plane_rows(plane: Float64, covariance: Float64) -> tuple[ValueRow, ...]:
    """Return the four numbers of a plane (4,) in the tool frame, with its covariance (4, 4)."""
    rows = []
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    for what, name, value, sigma in zip(WORDS, PARAMETERS, plane.tolist(), sigmas.tolist(), strict=True):
        low, high = value - HALF_95 * sigma, value + HALF_95 * sigma
        unit = "mm" if name == "d_mm" else ""
        if not unit:
            # A unit vector's component ends at 1.
            low, high = (min(max(end, -1.0), 1.0) for end in (low, high))
        rows.append(row_of(what, f"plane_in_tool, {name}", value, sigma, unit, ends=(low, high)))
    return tuple(rows)


def plane_in_words(plane: Float64) -> str:
    """Return a plane (4,) of the tool frame as a headline."""
    n_x, n_y, n_z, d = plane
    return f"[{n_x:.5f}, {n_y:.5f}, {n_z:.5f}, {d:.3f}] in the tool frame"


def turned_deg(plane: Float64, setup: Setup) -> float:
    """Return the angle of a plane (4,) to the one that a setup states, deg."""
    return math.degrees(math.acos(np.clip(plane[:3] @ setup.laser.plane[:3], -1.0, 1.0)))


def _axes_of(result: LaserCalibration) -> tuple[Float64, Float64]:
    """Return the mean direction of the stripes (3,), and that square to it within the plane (3,)."""
    normal = result.plane[:3]
    directions: list[Float64] = []
    for line in result.lines:
        ends = line.points(line.line.rays)
        along = ends[1] - ends[0]
        directions.append(along * np.sign(along @ (directions[0] if directions else along)))
    along = np.mean(directions, axis=0)
    along = along - (along @ normal) * normal
    along = along / np.linalg.norm(along)
    across = np.cross(normal, along)
    return along, across * np.sign(across[2] or 1.0)


def _in_plane(result: LaserCalibration) -> str:
    figure = style.new_figure(10.5, 4.2, "")
    axes = style.plain(figure.add_subplot(), "along the stripes [mm]", "across them, away [mm]")
    along, across = _axes_of(result)
    for points, line in zip(result.points_mm, result.lines, strict=True):
        (drawn,) = axes.plot(points @ along, points @ across, ".", markersize=2, rasterized=True)
        ends = line.points(line.line.rays)
        axes.plot(ends @ along, ends @ across, "-", color=drawn.get_color(), linewidth=1.0)
    axes.set_aspect("equal", adjustable="datalim")
    return svg(figure)


def _residuals(result: LaserCalibration) -> str:
    figure = style.new_figure(10.5, 4.2, "")
    course, pairs = figure.subplots(1, 2)
    along, _ = _axes_of(result)
    style.plain(course, "along the stripe [mm]", "mm", "off the sheet")
    places = [points @ along for points in result.points_mm]
    for place, off in zip(places, result.off_mm, strict=True):
        course.plot(place, off, ".", markersize=2, alpha=0.6, rasterized=True)
    where, off = np.concatenate(places), np.concatenate(result.off_mm)
    edges = np.linspace(where.min(), where.max(), BINS + 1)
    part = np.searchsorted(edges, where).clip(1, BINS) - 1
    full = [n for n in range(BINS) if (part == n).sum() >= MIN_IN_BIN]
    course.plot(
        [0.5 * (edges[n] + edges[n + 1]) for n in full],
        [off[part == n].mean() for n in full],
        "-",
        color=style.BLACK,
        linewidth=1.5,
        label="mean of all pairs",
    )
    course.legend(fontsize=8)
    style.plain(pairs, "pair", "mm", "points of the fitted course off the sheet")
    for n, line in enumerate(result.lines):
        ends = off_sheet_mm(result.fit, result.stand, line.points(line.line.rays))
        sigma = np.sqrt(result.scatter * np.diag(line.covariance(result.plane[:3])))
        pairs.errorbar(
            n + np.linspace(-0.12, 0.12, len(ends)), ends, sigma, fmt="o", color=style.BLUE, markersize=4
        )
    pairs.axhline(0.0, color=style.BLACK, linewidth=0.8)
    pairs.set_xticks(range(len(result.names)), result.names, rotation=90, fontsize=7)
    return svg(figure)


def _image(result: LaserCalibration, pairs: LaserPairs) -> str:
    lens = pairs.scene.lens
    figure = style.new_figure(7.0, 0.5 + 7.0 * lens.height / lens.width, "")
    axes = style.plain(figure.add_subplot(), "column [px]", "row [px]")
    if pairs.sample is not None:
        low, high = np.percentile(pairs.sample, [1.0, 99.5])
        # Size to which the image behind the stripes is reduced, px.
        step = -(-max(pairs.sample.shape) // 800)
        axes.imshow(
            pairs.sample[::step, ::step],
            cmap="gray",
            vmin=low,
            vmax=max(high, low + 1.0),
            extent=(-0.5, lens.width - 0.5, lens.height - 0.5, -0.5),
        )
    axes.plot(*pairs.seen.points_px.T, ".", color=style.SKY, markersize=1.5, alpha=0.5, rasterized=True)
    for stripe in result.stripes:
        axes.plot(*stripe.points_px.T, ".", markersize=1.5, rasterized=True)
    axes.grid(visible=False)
    style.over_image(axes, lens.width, lens.height)
    return svg(figure)


ANGLES, MIN_IN_ANGLE = 24, 10
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
    full = [n for n in range(ANGLES) if (part == n).sum() >= MIN_IN_ANGLE]
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
