"""calibrate_hand_eye.html: the camera's pose on a robot in words and pictures."""

import math
from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from scipy.spatial.transform import Rotation

from arctrack.calibrate.hand_eye.hand_eye_poses import PosedBoards, assumption
from arctrack.calibrate.page import EXACT_LENS, CalibrationPage, PagePicture, ValueRow, row_of, with_reasons
from arctrack.report import style
from arctrack.report.embedded import svg
from calibration.hand_eye_boards.calibrate import HandEyeCalibration
from calibration.hand_eye_boards.robot_error import JOINTS, NONE, SMOOTH
from calibration.rigid import inverse, transform_each
from noise_model.calibration_errors import POSE
from noise_model.setup import Setup


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


AXES = "xyz"

ERRORS = {
    NONE: "no repeatable error",
    JOINTS: "offsets of its joints",
    SMOOTH: "errors that change slowly from pose to pose",
}

STEP_DEG = 1e-4
"""Step of the derivatives of a rotation vector."""


def hand_eye_page(
    result: HandEyeCalibration, posed: PosedBoards, setup: Setup, *, moves_sheet: bool
) -> CalibrationPage:
    """Return the page's content; with `moves_sheet` a calibrated laser sheet moves with the camera."""
    x, y, z = result.T_holder_camera[:3, 3]
    sigma_mm = math.sqrt(float(np.trace(result.place_covariance)))
    count = len(result.names) + len(result.left_out) + len(posed.left_out)
    turns = ", ".join(f"{turn:.0f}" for turn in result.turns_deg)
    holder = "robot's base" if result.is_eye_to_hand else "tool"
    sentences = [
        f"{len(result.names)} of {count} images and poses are used. The camera's place is known to "
        f"{sigma_mm:.3f} mm, 1 σ of its three axes together.",
        f"The robot's own error is {result.robot_mm:.3f} ± {result.robot_sigma[1]:.3f} mm and "
        f"{result.robot_deg:.4f} ± {result.robot_sigma[0]:.4f}° about each axis (1 σ). A corner's noise is "
        f"{result.corner_sigma_px:.3f} px.",
        _repeatable(result),
        f"The poses turn by {turns}° RMS about x, y and z of the {holder}. A turn about one axis tells the "
        "camera's place along the other two.",
    ]
    sentences.append(assumption(result))
    if result.is_eye_to_hand:
        sentences.append(
            "The camera's pose in base is kept in [calibration.camera_in_base]. "
            "[camera.pose_in_tool] stays as it was."
        )
    else:
        turn_deg, move_mm = change(result, setup)
        sentences.append(
            f"The camera is turned by {np.linalg.norm(turn_deg):.2f}° and moved by "
            f"{np.linalg.norm(move_mm):.2f} mm against the pose stated before."
        )
    return CalibrationPage(
        title="arctrack calibrates the camera's pose",
        label="camera in base" if result.is_eye_to_hand else "camera in the tool",
        headline=f"[{x:.3f}, {y:.3f}, {z:.3f}] mm in the {holder}",
        sentences=tuple(sentences),
        rows=hand_eye_rows(result, setup),
        pictures=(
            PagePicture(
                misfits(result),
                "how far the robot was off each pose, most likely",
                "Both are the tool's. Lines are the mean of three axes of the estimated noise.",
            ),
            PagePicture(
                excitation(result),
                "how far the poses turn, and how well each part of the camera's pose is known",
                "Bars on the right are 1 σ. A long one wants poses that turn about another axis.",
            ),
            PagePicture(
                places(result), "where the camera stood, and where it looked, in the board's frame", ""
            ),
            PagePicture(
                robot_off(result),
                "from where the robot's pose puts ends and middle of each board, to where they are seen",
                "This is the robot's error, seen by the camera. Grey are all corners.",
            ),
        ),
        notes=tuple(_notes(result, posed, moves_sheet)),
        mark="ambiguous" if result.left_out or result.is_scale_off else "no_gap",
        left_out=with_reasons(posed.left_out | result.left_out),
    )


def _repeatable(result: HandEyeCalibration) -> str:
    """Return which model of the robot's repeatable error is taken, and how well each predicts a board."""
    taken = result.robot_error
    tried = ", ".join(f"{each.rms_mm:.2f} mm with {ERRORS[each.name]}" for each in result.robot_errors)
    words = f"Predicted by the others, a board's corners are off by {tried} (RMS). "
    if taken.name == NONE:
        return words + "No repeatable error of the robot is taken: none predicts boards better beyond doubt."
    return words + (
        f"The robot is taken to have {ERRORS[taken.name]}: the camera's pose counts without it, and the "
        "robot's error above is what is left."
    )


def change(result: HandEyeCalibration, setup: Setup) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera's rotation (3,), deg, and translation (3,), mm, in its own frame."""
    stated = setup.camera.T_tool_camera
    turn = stated[:3, :3].T @ result.T_holder_camera[:3, :3]
    move = stated[:3, :3].T @ (result.T_holder_camera[:3, 3] - stated[:3, 3])
    return np.degrees(Rotation.from_matrix(turn).as_rotvec()), move


def hand_eye_rows(result: HandEyeCalibration, setup: Setup) -> tuple[ValueRow, ...]:
    """Return place, turn, the robot's noise, and the board's size by the robot."""
    rows = []
    sigmas = np.sqrt(np.diag(result.place_covariance))
    wider = float(np.max(result.half_interval() / result.sigma))
    for axis, value, sigma in zip(AXES, result.T_holder_camera[:3, 3], sigmas, strict=True):
        rows.append(_row(f"place, {axis}", f"translation_mm, {axis}", value, sigma, wider * sigma, "mm"))
    turns, turn_sigmas, halves = change(result, setup)[0], result.sigma[:3], result.half_interval()[:3]
    words = "turn about the camera's {}, against before"
    if result.is_eye_to_hand:
        turns, turn_sigmas = _rotation_vector(result)
        words, halves = "rotation vector, {}", wider * turn_sigmas
    for axis, value, sigma, half in zip(AXES, turns, turn_sigmas, halves, strict=True):
        rows.append(_row(words.format(axis), "quaternion_xyzw", value, sigma, half, "deg"))
    for what, key, value, sigma, unit in (
        ("robot's place, each axis", "robot_sigma_mm", result.robot_mm, result.robot_sigma[1], "mm"),
        ("robot's turn, each axis", "robot_sigma_deg", result.robot_deg, result.robot_sigma[0], "deg"),
        *_offsets(result),
        ("board's size by the robot", "", result.scale, result.scale_sigma, "of that stated"),
    ):
        rows.append(row_of(what, key, value, sigma, unit))
    return tuple(rows)


def _offsets(result: HandEyeCalibration) -> Iterator[tuple[str, str, float, float, str]]:
    """Yield the parts of a row for each joint whose offset is taken."""
    if result.robot_error.name == JOINTS:
        for joint, offset, sigma in zip(result.joints, *result.joint_offsets, strict=True):
            yield f"offset of joint {joint}", "joint_offsets_deg", float(offset), float(sigma), "deg"


def _rotation_vector(result: HandEyeCalibration) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera's rotation vector (3,) and its sigmas (3,), deg."""
    turn = Rotation.from_matrix(result.T_holder_camera[:3, :3])
    vector = turn.as_rotvec(degrees=True)
    steps = Rotation.from_rotvec(STEP_DEG * np.eye(3), degrees=True)
    J = ((turn * steps).as_rotvec(degrees=True) - vector).T / STEP_DEG
    return vector, np.sqrt(np.diag(J @ result.covariance[:3, :3] @ J.T))


def _row(what: str, key: str, value: float, sigma: float, half: float, unit: str) -> ValueRow:
    return row_of(what, key, value, sigma, unit, ends=(value - half, value + half))


def _notes(result: HandEyeCalibration, posed: PosedBoards, moves_sheet: bool) -> list[str]:
    notes = [
        "The lens is held as the setup states it. Its error is in these sigmas, and so is an error of the "
        "camera's place that undoes it: the two together see better than either."
    ]
    if posed.lens_covariance is None:
        notes = [EXACT_LENS]
    if not result.is_eye_to_hand:
        deg, mm = float(result.sigma[:3].max()), float(result.sigma[3:].max())
        notes.append(
            "A track's sigmas go by hand_eye_deg and hand_eye_mm of [tolerance], which stay as they were: "
            f"this calibration knows {deg:.2g}° and {mm:.2g} mm along the worst axes."
        )
        notes.append(
            "The laser sheet was calibrated before, in the camera's frame. It moves with the camera."
            if moves_sheet
            else "The laser's plane in the tool stays as it was stated. `arctrack calibrate laser` puts it "
            "where this pose of the camera sees it."
        )
    if result.is_scale_off:
        notes.append(
            f"The robot's motions make the board {result.scale:.4f} ± {result.scale_sigma:.4f} times as "
            "large as stated: measure its squares, or calibrate the camera anew."
        )
    return notes
