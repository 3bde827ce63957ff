"""A setup's lens as a file of mrcal, Kalibr or ROS."""

from collections.abc import Callable
from typing import Any

import numpy as np
import yaml

from noise_model.calibration_errors import OPENCV
from noise_model.instrument.camera import Camera


def mrcal_text(camera: Camera) -> str:
    """Return mrcal's cameramodel; ValueError for a distortion that it has no model for."""
    count, values = _distortion(camera, "mrcal", (5, 8, 12))
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy, *values]
    return (
        "{\n"
        f"    'lensmodel':  'LENSMODEL_OPENCV{count}',\n\n"
        "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n"
        f"    'intrinsics': {intrinsics},\n\n"
        "    # extrinsics are rt_fromref\n"
        "    'extrinsics': [0, 0, 0, 0, 0, 0],\n\n"
        f"    'imagersize': [{camera.width}, {camera.height}]\n"
        "}\n"
    )


def kalibr_text(camera: Camera) -> str:
    """Return Kalibr's camchain of one camera; ValueError for a distortion beyond k1 k2 p1 p2."""
    return _yaml(
        {
            "cam0": {
                "cam_overlaps": [],
                "camera_model": "pinhole",
                "distortion_coeffs": _distortion(camera, "Kalibr", (4,))[1],
                "distortion_model": "radtan",
                "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
                "resolution": [camera.width, camera.height],
                "rostopic": "/camera/image_raw",
            }
        }
    )


def ros_text(camera: Camera) -> str:
    """Return ROS' camera_info; ValueError for a distortion beyond rational_polynomial."""
    count, values = _distortion(camera, "ROS", (5, 8))
    matrix = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    return _yaml(
        {
            "image_width": camera.width,
            "image_height": camera.height,
            "camera_name": "camera",
            "camera_matrix": _matrix(matrix),
            "distortion_model": "plumb_bob" if count == 5 else "rational_polynomial",
            "distortion_coefficients": _matrix([values]),
            "rectification_matrix": _matrix(np.eye(3).tolist()),
            "projection_matrix": _matrix([[*row, 0.0] for row in matrix]),
        }
    )


WRITERS: dict[str, Callable[[Camera], str]] = {"mrcal": mrcal_text, "kalibr": kalibr_text, "ros": ros_text}


def _distortion(camera: Camera, program: str, counts: tuple[int, ...]) -> tuple[int, list[float]]:
    """Return how many coefficients a program's leanest model has that holds all, and their values."""
    used = max((n + 1 for n, value in enumerate(camera.distortion) if value != 0.0), default=0)
    count = next((count for count in counts if count >= used), None)
    if count is None:
        lost = ", ".join(f"{name} = {value:g}" for name, value in _beyond(camera, counts[-1]))
        raise ValueError(
            f"[camera] distortion: {lost} is not 0: {program} has {' '.join(OPENCV[: counts[-1]])} alone"
        )
    padded = [*camera.distortion, *[0.0] * len(OPENCV)]
    return count, [float(value) for value in padded[:count]]


def _beyond(camera: Camera, count: int) -> list[tuple[str, float]]:
    stated = zip(OPENCV[count:], camera.distortion[count:], strict=False)
    return [(name, value) for name, value in stated if value != 0.0]


def _matrix(rows: list[list[float]]) -> dict[str, Any]:
    return {"rows": len(rows), "cols": len(rows[0]), "data": [value for row in rows for value in row]}


def _yaml(content: dict[str, Any]) -> str:
    text: str = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=10**6)
    return text
