"""The pictures of a camera's pose on a robot: misfits, motions, views."""

import math

import numpy as np
from matplotlib.axes import Axes

from arctrack.report import style
from arctrack.report.embedded import svg
from calibration.hand_eye_boards.calibrate import HandEyeCalibration
from calibration.rigid import inverse, transform_each
from noise_model.calibration_errors import POSE


def misfits(result: HandEyeCalibration) -> str:
    """Return a figure of the robot's error at each pose."""
    figure = style.new_figure(10.5, 3.8, "")
    mean = 2.0 * math.sqrt(2.0 / math.pi)
    for axes, off, sigma, unit, title in zip(
        figure.subplots(1, 2),
        (result.off_mm, result.off_deg),
        (result.robot_mm, result.robot_deg),
        ("mm", "deg"),
        ("place", "turn"),
        strict=True,
    ):
        style.plain(axes, "", unit, title)
        rows = range(len(off))
        axes.bar(rows, off, color=style.SKY)
        axes.axhline(mean * sigma, color=style.BLACK, linewidth=0.8)
        axes.set_xticks(rows, [name[-16:] for name in result.names], rotation=90, fontsize=7)
    return svg(figure)


def excitation(result: HandEyeCalibration) -> str:
    """Return a figure of the poses' rotations, and of 1 sigma of the camera's pose."""
    figure = style.new_figure(10.5, 3.2, "")
    turns, sigma_deg, sigma_mm = figure.subplots(1, 3)
    holder = "base" if result.is_eye_to_hand else "tool"
    for axes, names, values, unit, title, colour in (
        (turns, list("xyz"), result.turns_deg, "deg", f"turn about the {holder}'s axes, RMS", style.GREEN),
        (sigma_deg, list(POSE[:3]), result.sigma[:3], "deg", "1 σ, camera's own axes", style.BLUE),
        (sigma_mm, list(POSE[3:]), result.sigma[3:], "mm", "1 σ, camera's own axes", style.BLUE),
    ):
        style.plain(axes, "", unit, title)
        axes.bar(range(3), values, color=colour)
        axes.set_xticks(range(3), [name.removesuffix("_deg").removesuffix("_mm") for name in names])
    return svg(figure)


def places(result: HandEyeCalibration) -> str:
    """Return a figure of the camera's places in the board's frame, from above and from the side."""
    figure = style.new_figure(10.5, 4.2, "")
    T_board_camera = inverse(result.refined.boards.scene.T_camera_board)
    where, sight = T_board_camera[:, :3, 3], T_board_camera[:, :3, 2]
    # Length of the camera's line of sight, over its distance to the board.
    reach = 0.25 * float(np.median(np.linalg.norm(where, axis=1)))
    corners = result.refined.boards.seen.board.points_mm
    for axes, (a, b) in zip(figure.subplots(1, 2), ((0, 1), (0, 2)), strict=True):
        style.plain(axes, f"board's {'xyz'[a]} [mm]", f"board's {'xyz'[b]} [mm]")
        axes.plot(corners[:, a], corners[:, b], ".", color=style.GREY, markersize=2)
        axes.quiver(
            where[:, a],
            where[:, b],
            reach * sight[:, a],
            reach * sight[:, b],
            angles="xy",
            scale_units="xy",
            scale=1.0,
            color=style.BLUE,
            width=0.004,
        )
        axes.plot(where[:, a], where[:, b], "o", color=style.VERMILLION, markersize=4)
        axes.set_aspect("equal", adjustable="datalim")
        axes.invert_yaxis()
    return svg(figure)


def robot_off(result: HandEyeCalibration) -> str:
    """Return a figure of the boards' ends against their places by the robot's poses, as arrows."""
    boards, T = result.refined.boards, result.refined.chain.T_camera_board
    lens, seen = boards.scene.lens, boards.seen
    ends = np.array([part.start + n for part in seen.slices for n in (0, (part.stop - part.start) - 1)])
    ends = np.concatenate([ends, [part.start + (part.stop - part.start) // 2 for part in seen.slices]])
    view = seen.view[ends]
    points = transform_each(T[view], seen.flat_mm[ends])
    predicted = lens.project(points)
    off = seen.points_px[ends] - predicted
    longest = float(np.quantile(np.linalg.norm(off, axis=1), 0.95))
    # Length of the arrow of the 95 % quantile, over the image's width.
    stretch = 0.08 * lens.width / max(longest, 1e-9)
    title = f"arrows {stretch:.2g} times as long; {longest:.2g} px is the 95 % quantile"
    figure = style.new_figure(7.0, 0.7 + 7.0 * lens.height / lens.width, "")
    axes: Axes = style.plain(figure.add_subplot(), "column [px]", "row [px]", title)
    axes.plot(*seen.points_px.T, ".", color=style.GREY, markersize=1.5, alpha=0.5, rasterized=True)
    arrows = stretch * off.T
    axes.quiver(
        *predicted.T, *arrows, angles="xy", scale_units="xy", scale=1.0, color=style.BLUE, width=0.003
    )
    style.over_image(axes, lens.width, lens.height)
    return svg(figure)
