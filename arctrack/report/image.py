"""Frames as people want to see them: dark things visible, stripe and seam drawn over them."""

import base64
import io

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from noise_model.compiled.arrays import Float64, UInt8
from noise_model.instrument.camera import Camera
from noise_model.instrument.sensor import Sensor
from noise_model.setup import Setup
from noise_model.transforms import invert, transform
from tracker.state import Frame, Stripe, Track


def uri(kind: str, content: bytes) -> str:
    """Return a file's content as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def visible(image_dn: npt.NDArray[np.integer | np.floating], sensor: Sensor) -> UInt8:
    """Return a raw frame (H, W) as 8-bit grey, by the square root, under which noise is uniform."""
    signal = np.maximum(image_dn.astype(np.float32) - sensor.black_level_dn, 0.0)
    scaled = 255.0 * np.sqrt(signal / max(1.0, sensor.max_dn - sensor.black_level_dn))
    grey: UInt8 = np.clip(np.rint(scaled), 0, 255).astype(np.uint8)
    return grey


def frame_picture(frame: Frame, setup: Setup) -> UInt8:
    """Return a frame as 8-bit grey (H, W): an image by `visible`, a profile as points."""
    if setup.profiler is None:
        return visible(frame.image_dn, setup.sensor)
    picture = np.zeros((setup.camera.height, setup.camera.width), np.uint8)
    rows_px = setup.profiler.rows_px(setup.profiler.z_mm(frame.image_dn[0]))
    columns = np.flatnonzero(np.isfinite(rows_px))
    picture[np.rint(rows_px[columns]).astype(np.int64), columns] = 255
    return picture


def shrunk(grey: UInt8, bin_px: int) -> UInt8:
    """Return the means over bins of a picture (H, W), what is left of a bin at its ends cut off."""
    h, w = grey.shape[0] // bin_px, grey.shape[1] // bin_px
    whole = grey[: h * bin_px, : w * bin_px].astype(np.float32)
    return np.rint(cv2.resize(whole, (w, h), interpolation=cv2.INTER_AREA)).astype(np.uint8)


def jpeg(grey: UInt8) -> bytes:
    """Return a grey picture (H, W) as a JPEG file."""
    file = io.BytesIO()
    Image.fromarray(grey).save(file, format="jpeg", quality=75, optimize=True)
    return file.getvalue()


def stripe_points_px(stripe: Stripe) -> Float64:
    """Return the stripe's points in the image (n, 2), x y."""
    lines = np.flatnonzero(np.isfinite(stripe.position_px))
    positions = stripe.position_px[lines]
    return np.column_stack([lines, positions] if stripe.along_rows else [positions, lines]).astype(float)


def seam_point_px(track: Track, camera: Camera) -> Float64 | None:
    """Return the image point x y of a valid track's seam, None if it is not valid or out of the image."""
    return project_tool_point(np.asarray(track.seam_tool_mm), camera) if track.valid else None


def project_tool_point(point_tool_mm: Float64, camera: Camera) -> Float64 | None:
    """Return the image point x y of a point (3,), mm, tool frame; None if unknown or out of the image."""
    if not np.isfinite(point_tool_mm).all():
        return None
    point = camera.project(transform(invert(camera.T_tool_camera), point_tool_mm[None, :]))[0]
    inside = (point >= -0.5).all() and point[0] < camera.width and point[1] < camera.height
    return np.asarray(point) if inside else None


def annotate(grey: UInt8, track: Track, camera: Camera) -> UInt8:
    """Return a grey picture (H, W) in colour (H, W, 3) BGR with the fitted stripe and a cross on the seam."""
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    if track.stripe is not None:
        x, y = np.rint(stripe_points_px(track.stripe)).astype(int).T
        inside = (x >= 0) & (x < picture.shape[1]) & (y >= 0) & (y < picture.shape[0])
        picture[y[inside], x[inside]] = (0, 159, 230)
    point = seam_point_px(track, camera)
    if point is not None:
        size = max(8, camera.width // 20)
        cross = (round(point[0]), round(point[1]))
        cv2.drawMarker(picture, cross, (233, 180, 86), cv2.MARKER_CROSS, size, 2, cv2.LINE_AA)
    return np.asarray(picture, dtype=np.uint8)
