"""Common mistakes in poses, frames and setup, each with how it is undone: hypotheses that can be tried."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.check.check_sample import CheckCase
from arctrack.nominal import DIMENSIONS
from noise_model.compiled.arrays import Float64, Integers
from noise_model.instrument.camera import Camera
from noise_model.surface.joint import Joint
from noise_model.transforms import invert

FOCAL_STEP, FOCAL_OVER_WIDTH = 1.04, (0.4, 12.0)
"""Focal lengths to try: the ratio of two, and the least and most over the image's width."""

MAX_REACH_MM = 1e4
"""No seam in m is taken to reach farther, mm: twice the reach of the largest welding robots."""

LENGTH_UNITS_MM = {"m": 1000.0, "cm": 10.0, "inches": 25.4}

TIME_UNITS = {"ms": 1e-3, "µs": 1e-6, "ns": 1e-9}


@dataclass(frozen=True)
class Mistake:
    """A possible mistake, its cure, and what returns a case without it, None for one that cannot have it."""

    what: str
    cure: str
    undo: Callable[[CheckCase], CheckCase | None]


def common_mistakes(T_tool_controllertool: Float64) -> list[Mistake]:
    """Return the mistakes, the commonest first; the tool frame that the setup states already is (4, 4)."""
    return [
        *_times(),
        *_poses(),
        *_images(),
        *_hand_eye(),
        *_laser(),
        *_joint(),
        *_tool_axes(T_tool_controllertool),
        *_camera_axes(),
    ]


def focal_lengths(camera: Camera) -> list[Mistake]:
    """Return other focal lengths than the stated one as mistakes."""
    low, high = np.log(FOCAL_OVER_WIDTH) / np.log(FOCAL_STEP)
    ratios = FOCAL_STEP ** np.arange(np.floor(low), high)
    return [_focal_length(camera.fx, float(ratio * camera.width)) for ratio in ratios]


def other_joints(stated: Joint) -> list[Mistake]:
    """Return the other types of joints as mistakes, with nominal dimensions."""
    return [
        Mistake(
            f"[joint] type = {stated.type!r}: the stripe shows a {name}",
            f"recording.toml: state {name} and its dimensions",
            partial(_with_joint, joint=replace(stated, type=name, dimensions=dimensions, section_mm=())),
        )
        for name, dimensions in DIMENSIONS.items()
        if name != stated.type
    ]


def _times() -> Iterator[Mistake]:
    for unit, factor in TIME_UNITS.items():
        cure = "give timestamp_s in seconds"
        yield Mistake(
            f"the times of poses are in {unit}",
            f"poses.csv: {cure}",
            partial(CheckCase.with_times, poses=factor),
        )
        yield Mistake(
            f"the times of frames are in {unit}",
            f"frames.csv: {cure}",
            partial(CheckCase.with_times, frames=factor),
        )


def _poses() -> Iterator[Mistake]:
    def poses(what: str, cure: str, change: Callable[[Float64], Float64]) -> Mistake:
        return Mistake(
            f"the poses {what}", f"poses.csv: {cure}", partial(CheckCase.with_poses, change=change)
        )

    yield poses("have their quaternions as w x y z", "put qw last", _from_wxyz)
    for unit, factor in LENGTH_UNITS_MM.items():
        yield poses(f"are in {unit}", "give x_mm, y_mm, z_mm in mm", partial(_from_unit, factor=factor))
    yield Mistake(
        "the poses and [joint] seam_in_base_mm are in m", "give both in mm", _with_poses_and_seam_in_mm
    )
    yield poses("are inverted: they take points of base to the tool", "give the tool's place in base", invert)
    yield poses("have conjugated quaternions", "change the signs of qx, qy, qz", _turned_back)


def _images() -> Iterator[Mistake]:
    def frames(what: str, turn: Callable[[Integers], Integers]) -> Mistake:
        return Mistake(
            f"the frames are {what}",
            "frames: write them as [camera] and [camera.pose_in_tool] state them",
            partial(_with_images, turn=turn),
        )

    yield Mistake(
        "[camera] width and height are not those of the frames",
        "recording.toml: state the frames' size",
        _with_size,
    )
    yield Mistake(
        "[camera] is that of a larger or smaller image than the frames",
        "recording.toml: scale width, height, fx, fy, cx and cy to the frames' size",
        _with_scale,
    )
    yield frames("rotated by 180°", lambda image: image[::-1, ::-1])
    yield frames("mirrored left to right", lambda image: image[:, ::-1])
    yield frames("mirrored top to bottom", lambda image: image[::-1])
    yield frames("transposed", lambda image: image.T)
    yield frames("rotated by 90° to the left", lambda image: np.rot90(image, -1))
    yield frames("rotated by 90° to the right", np.rot90)
    yield frames("transposed and rotated by 180°", lambda image: image[::-1, ::-1].T)


def _hand_eye() -> Iterator[Mistake]:
    def hand_eye(what: str, cure: str, change: Callable[[Float64], Float64]) -> Mistake:
        return Mistake(
            f"[camera.pose_in_tool] {what}",
            f"recording.toml: {cure}",
            partial(_with_camera, change=partial(_with_camera_pose, change=change)),
        )

    yield hand_eye("is inverted", "give the camera's place in the tool frame", invert)
    yield hand_eye("has its quaternion as w x y z", "put w last", _from_wxyz)
    yield hand_eye("is in m", "give translation_mm in mm", partial(_from_unit, factor=1000.0))
    for name in ("fx", "fy"):
        yield Mistake(
            f"[camera] {name} is not that of this lens",
            "recording.toml: fx and fy are alike where pixels are square",
            partial(_with_square_pixels, wrong=name),
        )
    yield Mistake(
        "[camera] cx and cy are exchanged",
        "recording.toml: cx goes with the width, cy with the height",
        partial(_with_camera, change=lambda camera: replace(camera, cx=camera.cy, cy=camera.cx)),
    )


def _laser() -> Iterator[Mistake]:
    for name, index in (("last", 3), ("third", 2), ("second", 1)):
        yield Mistake(
            f"[laser] plane_in_tool: its {name} number has the wrong sign",
            "recording.toml: n·p + d = 0 holds for the sheet's points p in the tool frame",
            partial(_with_plane, index=index, factor=-1.0),
        )
    yield Mistake(
        "[laser] plane_in_tool: its last number is in m",
        "recording.toml: give it in mm",
        partial(_with_plane, index=3, factor=1000.0),
    )


def _joint() -> Iterator[Mistake]:
    yield Mistake(
        "[joint] surface_normal_in_base points into the part",
        "recording.toml: it points out of the workpiece, towards the torch",
        _with_normal_turned,
    )
    yield Mistake("[joint] seam_in_base_mm is in m", "recording.toml: give it in mm", _with_seam_in_mm)


def _tool_axes(T_tool_controllertool: Float64) -> Iterator[Mistake]:
    """Yield tool frames whose axes are arctrack's in another order or with other signs."""
    for turn in _quarter_turns():
        T_stated = invert(turn) @ T_tool_controllertool
        quaternion = Rotation.from_matrix(T_stated[:3, :3]).as_quat(canonical=True)
        yield Mistake(
            f"the poses' tool {_tool_axes_in_words(turn)}",
            f"recording.toml: [robot.controllertool_to_tool] translation_mm = {_numbers(T_stated[:3, 3])}, "
            f"quaternion_xyzw = {_numbers(quaternion)}",
            partial(CheckCase.with_tool, T_tool_controllertool=T_stated),
        )


def _tool_axes_in_words(turn: Float64) -> str:
    """Return what is wrong with a tool's axes if arctrack's are the columns of `turn` (4, 4) among them."""
    x, z = _axis(turn[:3, 0]), _axis(turn[:3, 2])
    if z == "-z":
        return f"z points into the part (its {x} is arctrack's x)"
    if z == "+z":
        return f"x does not point along the travel (its {x} does)"
    return f"z does not point away from the part (its {z} does, and its {x} along the travel)"


def _camera_axes() -> Iterator[Mistake]:
    for turn in _quarter_turns():
        x, z = _axis(turn[:3, 0]), _axis(turn[:3, 2])
        yield Mistake(
            f"[camera.pose_in_tool] has other axes than OpenCV's (its {x} runs right, its {z} forward)",
            "recording.toml: the camera's x runs right, y down, z forward",
            partial(_with_camera, change=partial(_with_camera_turned, turn=turn)),
        )


def _focal_length(stated_px: float, focal_px: float) -> Mistake:
    return Mistake(
        f"[camera] fx, fy: about {focal_px:.0f} px fit, not {stated_px:.4g}",
        "recording.toml: give the calibration's, in px of this image size",
        partial(_with_camera, change=partial(_with_focal, focal_px=focal_px)),
    )


def _quarter_turns() -> list[Float64]:
    """Return the 23 turns (4, 4) that take axes to axes, those by 180° about one of them first."""
    turns = []
    for rotation in Rotation.create_group("O"):
        turn = np.eye(4)
        turn[:3, :3] = np.rint(rotation.as_matrix())
        turns.append(turn)
    # The sum of the diagonal's sizes is 3 for those that keep each axis in its line.
    ordered = sorted(turns, key=lambda turn: -float(np.abs(np.diag(turn[:3, :3])).sum()))
    return [turn for turn in ordered if not np.array_equal(turn, np.eye(4))]


def _axis(direction: Float64) -> str:
    """Return the name of an axis with its sign."""
    index = int(np.argmax(np.abs(direction)))
    return f"{'-' if direction[index] < 0.0 else '+'}{'xyz'[index]}"


def _numbers(values: Float64) -> str:
    # Adding 0 takes the sign off a zero.
    return f"[{', '.join(f'{value + 0.0:.7g}' for value in values)}]"


def _from_wxyz(T: Float64) -> Float64:
    """Return the pose (4, 4) whose quaternion w x y z was taken for x y z w."""
    w, x, y, z = Rotation.from_matrix(T[:3, :3]).as_quat()
    changed = T.copy()
    changed[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    return changed


def _turned_back(T: Float64) -> Float64:
    changed = T.copy()
    changed[:3, :3] = T[:3, :3].T
    return changed


def _from_unit(T: Float64, factor: float) -> Float64:
    changed = T.copy()
    changed[:3, 3] *= factor
    return changed


def _with_images(case: CheckCase, turn: Callable[[Integers], Integers]) -> CheckCase | None:
    turned = case.with_images(turn)
    return turned if turned.fits_camera else None


def _with_size(case: CheckCase) -> CheckCase | None:
    if case.fits_camera:
        return None
    width, height = case.size_px
    return _with_camera(case, lambda camera: replace(camera, width=width, height=height))


def _with_scale(case: CheckCase) -> CheckCase | None:
    camera, (width, height) = case.setup.camera, case.size_px
    ratio = width / camera.width
    if case.fits_camera or camera.height * ratio != height:
        return None
    # Pixels are counted from the middle of the first.
    cx, cy = (ratio * (c + 0.5) - 0.5 for c in (camera.cx, camera.cy))
    scaled = replace(camera, width=width, height=height, fx=ratio * camera.fx, fy=ratio * camera.fy)
    return case.with_setup(replace(case.setup, camera=replace(scaled, cx=cx, cy=cy)))


def _with_square_pixels(case: CheckCase, wrong: str) -> CheckCase | None:
    camera = case.setup.camera
    if 1.0 / FOCAL_STEP < camera.fx / camera.fy < FOCAL_STEP:
        return None
    right = camera.fy if wrong == "fx" else camera.fx
    return _with_camera(case, lambda camera: replace(camera, fx=right, fy=right))


def _with_camera(case: CheckCase, change: Callable[[Camera], Camera]) -> CheckCase:
    return case.with_setup(replace(case.setup, camera=change(case.setup.camera)))


def _with_camera_pose(camera: Camera, change: Callable[[Float64], Float64]) -> Camera:
    return replace(camera, T_tool_camera=change(camera.T_tool_camera))


def _with_camera_turned(camera: Camera, turn: Float64) -> Camera:
    return replace(camera, T_tool_camera=camera.T_tool_camera @ turn)


def _with_focal(camera: Camera, focal_px: float) -> Camera:
    return replace(camera, fx=focal_px, fy=focal_px * camera.fy / camera.fx)


def _with_plane(case: CheckCase, index: int, factor: float) -> CheckCase | None:
    a, b, c, d = (
        factor * value if n == index else value for n, value in enumerate(case.setup.laser.plane_in_tool)
    )
    if (a, b, c, d) == case.setup.laser.plane_in_tool:
        return None
    laser = replace(case.setup.laser, plane_in_tool=(a, b, c, d))
    return case.with_setup(replace(case.setup, laser=laser))


def _with_joint(case: CheckCase, joint: Joint) -> CheckCase:
    return case.with_setup(replace(case.setup, joint=joint))


def _with_normal_turned(case: CheckCase) -> CheckCase:
    x, y, z = case.setup.joint.surface_normal_in_base
    normals = case.setup.joint.surface_normals_in_base
    if normals is not None:
        normals = tuple((-u, -v, -w) for u, v, w in normals)
    turned = replace(case.setup.joint, surface_normal_in_base=(-x, -y, -z), surface_normals_in_base=normals)
    return _with_joint(case, turned)


def _with_poses_and_seam_in_mm(case: CheckCase) -> CheckCase | None:
    return _with_seam_in_mm(case.with_poses(partial(_from_unit, factor=1000.0)))


def _with_seam_in_mm(case: CheckCase) -> CheckCase | None:
    points = tuple((1000.0 * x, 1000.0 * y, 1000.0 * z) for x, y, z in case.setup.joint.seam_in_base_mm)
    if np.abs(points).max() > MAX_REACH_MM:
        return None
    return _with_joint(case, replace(case.setup.joint, seam_in_base_mm=points))
