"""MCAP files: a replay or a live run as messages over time, for Foxglove and all else that reads MCAP.

The messages are Foxglove's well-known ones, as JSON schemas of the fields that are used
(https://docs.foxglove.dev/docs/sdk/schemas), and arctrack's own. Foxglove counts lengths in m.
"""

import base64
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
import numpy.typing as npt
from mcap.writer import Writer
from PIL.ImageColor import getrgb
from scipy.spatial.transform import Rotation

from arctrack.output import writing
from arctrack.recording import Recording
from arctrack.replay.pages.drawing_spool import ReplayedFrame
from arctrack.replay.pages.numbers import MEANINGS, numbers, on_bus
from arctrack.replay.pages.view import ReplayView, chosen, stretches
from arctrack.report import style
from arctrack.report.image import jpeg
from noise_model.compiled.arrays import Float64
from noise_model.instrument.profiler import Profiler
from noise_model.setup import Setup
from tracker.checks import Check
from tracker.state import Frame

Schema = dict[str, Any]


def _record(title: str, /, **fields: Schema) -> Schema:
    return {"type": "object", "title": title, "properties": fields}


def _list(items: Schema) -> Schema:
    return {"type": "array", "items": items}


NUMBER: Schema = {"type": "number"}
WHOLE: Schema = {"type": "integer"}
TEXT: Schema = {"type": "string"}
FLAG: Schema = {"type": "boolean"}
BYTES: Schema = {"type": "string", "contentEncoding": "base64"}
TIME = _record("time", sec=WHOLE, nsec=WHOLE)
POINT_2 = _record("foxglove.Point2", x=NUMBER, y=NUMBER)
VECTOR_3 = _record("foxglove.Vector3", x=NUMBER, y=NUMBER, z=NUMBER)
QUATERNION = _record("foxglove.Quaternion", x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER)
COLOR = _record("foxglove.Color", r=NUMBER, g=NUMBER, b=NUMBER, a=NUMBER)

COMPRESSED_IMAGE = _record("foxglove.CompressedImage", timestamp=TIME, frame_id=TEXT, data=BYTES, format=TEXT)
CAMERA_CALIBRATION = _record(
    "foxglove.CameraCalibration",
    timestamp=TIME,
    frame_id=TEXT,
    width=WHOLE,
    height=WHOLE,
    distortion_model=TEXT,
    D=_list(NUMBER),
    K=_list(NUMBER),
    R=_list(NUMBER),
    P=_list(NUMBER),
)
FRAME_TRANSFORM = _record(
    "foxglove.FrameTransform",
    timestamp=TIME,
    parent_frame_id=TEXT,
    child_frame_id=TEXT,
    translation=VECTOR_3,
    rotation=QUATERNION,
)
POINT_CLOUD = _record(
    "foxglove.PointCloud",
    timestamp=TIME,
    frame_id=TEXT,
    pose=_record("foxglove.Pose", position=VECTOR_3, orientation=QUATERNION),
    point_stride=WHOLE,
    fields=_list(_record("foxglove.PackedElementField", name=TEXT, offset=WHOLE, type=WHOLE)),
    data=BYTES,
)
IMAGE_ANNOTATIONS = _record(
    "foxglove.ImageAnnotations",
    circles=_list(
        _record(
            "foxglove.CircleAnnotation",
            timestamp=TIME,
            position=POINT_2,
            diameter=NUMBER,
            thickness=NUMBER,
            fill_color=COLOR,
            outline_color=COLOR,
        )
    ),
    points=_list(
        _record(
            "foxglove.PointsAnnotation",
            timestamp=TIME,
            type=WHOLE,
            points=_list(POINT_2),
            outline_color=COLOR,
            outline_colors=_list(COLOR),
            fill_color=COLOR,
            thickness=NUMBER,
        )
    ),
    texts=_list(_record("foxglove.TextAnnotation")),
)
TRACK = _record(
    "arctrack.Track",
    frame=WHOLE,
    valid=FLAG,
    flags=_list(TEXT),
    bus=TEXT | {"description": "what became of the offset on the bus: sent, held or none"},
    **{name: NUMBER | {"description": meaning} for name, meaning in MEANINGS.items()},
    checks=_list(
        _record(
            "arctrack.Check",
            question=TEXT,
            words=TEXT,
            value=NUMBER,
            demand=TEXT,
            limit=NUMBER,
            outcome=TEXT,
            flag=TEXT,
        )
    ),
)


LINE_STRIP = 3
"""Foxglove's number for a line through points."""

PACKED_TYPES = {"|u1": 1, "<u2": 3, "<f4": 7}
"""Foxglove's numbers for the types of packed numbers."""

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
PROFILER_POINT = np.dtype([*POINT.descr, ("sigma", "<f4"), ("intensity", "<u2"), ("on_trace", "u1")])
"""A point that was read in an image, and a profiler's point, marked if it is on the surface's trace."""

M_PER_MM = 1e-3

TOPICS = {
    "/camera/image": COMPRESSED_IMAGE,
    "/camera/arc_map": COMPRESSED_IMAGE,
    "/camera/annotations": IMAGE_ANNOTATIONS,
    "/camera/calibration": CAMERA_CALIBRATION,
    "/tf": FRAME_TRANSFORM,
    "/profile": POINT_CLOUD,
    "/track": TRACK,
}
"""Each topic and its messages' schema."""


class McapFile:
    """Writer of an MCAP file, message by message; the context's end completes it.

    It begins at `first_s`. All times in it are `late_s` later than the frames', as its metadata say with
    `metadata`; `setups` are attached by their names, `setup` has the topics' sensor. Raises ArctrackError,
    which names the file, where it cannot be written.
    """

    def __init__(
        self,
        path: Path,
        setup: Setup,
        setups: Mapping[str, bytes],
        first_s: float,
        late_s: float,
        metadata: Mapping[str, str],
    ) -> None:
        self._path, self._late_s, self._profiler = path, late_s, setup.profiler
        with writing(path):
            self._file: IO[bytes] = path.open("wb")
        self._writer, self._channels = Writer(self._file), dict[str, int]()
        with writing(path):
            self._begin(setup, setups, self._ns(first_s), {**metadata, "seconds_later": f"{late_s:.15g}"})

    @classmethod
    def of_recording(cls, path: Path, recording: Recording) -> Self:
        """Begin the file of a replay.

        MCAP counts time from 0: where the recording begins before, times are whole seconds later.
        """
        first_s = min(row.timestamp_s for row in recording.rows)
        setups = {recording.setup_path.name: recording.setup_path.read_bytes()}
        late_s = max(0, math.ceil(-first_s))
        return cls(path, recording.setup, setups, first_s, late_s, {"recording": recording.name})

    def add(
        self, frame: Frame | None, seen: ReplayedFrame, view: ReplayView, true_mm: Float64 | None
    ) -> None:
        """Append a frame's messages, None if it could not be read."""
        track = seen.track
        ns = self._ns(track.timestamp_s)
        stamp = _stamp(ns)
        messages: dict[str, dict[str, Any]] = {"/track": _track(frame, seen, true_mm)}
        for topic, grey in (("/camera/image", view.grey), ("/camera/arc_map", view.arc_grey)):
            if grey is not None:
                messages[topic] = {
                    "timestamp": stamp,
                    "frame_id": "camera",
                    "data": _base64(jpeg(grey)),
                    "format": "jpeg",
                }
        if frame is not None:
            messages["/camera/annotations"] = _annotations(stamp, view)
        if seen.pose is not None:
            messages["/tf"] = _transform(stamp, "base", "tool", seen.pose.T_base_tool)
        if self._profiler is not None and frame is not None:
            points = _profiler_points(self._profiler, frame, view)
            messages["/profile"] = _point_cloud(stamp, "profile", points)
        elif view.profile is not None:
            points_m = (view.profile.points_mm * M_PER_MM).astype("<f4")
            messages["/profile"] = _point_cloud(stamp, "tool", points_m.view(POINT).ravel())
        with writing(self._path):
            for topic, message in messages.items():
                self._send(topic, message, ns)

    def add_message(self, topic: str, schema: Schema, message: dict[str, Any], time_s: float) -> None:
        """Append a message of another topic, at a time of the frames' clock; its schema has a title."""
        ns = self._ns(time_s)
        with writing(self._path):
            self._send(topic, {"timestamp": _stamp(ns), **message}, ns, schema)

    def _begin(
        self, setup: Setup, setups: Mapping[str, bytes], first_ns: int, metadata: dict[str, str]
    ) -> None:
        camera = setup.camera
        self._writer.start(library="arctrack")
        self._writer.add_metadata("arctrack", metadata)
        for name, text in setups.items():
            self._writer.add_attachment(first_ns, first_ns, name, "application/toml", text)
        stamp = _stamp(first_ns)
        K = camera.matrix
        calibration = {
            "timestamp": stamp,
            "frame_id": "camera",
            "width": camera.width,
            "height": camera.height,
            "distortion_model": "plumb_bob" if len(camera.distortion) == 5 else "rational_polynomial",
            "D": list(camera.distortion),
            "K": K.ravel().tolist(),
            "R": np.eye(3).ravel().tolist(),
            "P": np.column_stack([K, np.zeros(3)]).ravel().tolist(),
        }
        self._send("/camera/calibration", calibration, first_ns)
        self._send("/tf", _transform(stamp, "tool", "camera", camera.T_tool_camera), first_ns)
        if setup.profiler is not None:
            self._send("/tf", _transform(stamp, "tool", "profile", setup.profiler.T_tool_profile), first_ns)

    def _ns(self, time_s: float) -> int:
        return round((time_s + self._late_s) * 1e9)

    def _send(self, topic: str, message: dict[str, Any], ns: int, schema: Schema | None = None) -> None:
        if topic not in self._channels:
            schema = schema or TOPICS[topic]
            described = json.dumps(schema).encode()
            number = self._writer.register_schema(schema["title"], "jsonschema", described)
            self._channels[topic] = self._writer.register_channel(topic, "json", number)
        text = json.dumps(message, allow_nan=False, separators=(",", ":"))
        self._writer.add_message(self._channels[topic], ns, text.encode(), ns)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with writing(self._path), self._file:
            self._writer.finish()


def _track(frame: Frame | None, seen: ReplayedFrame, true_mm: Float64 | None) -> dict[str, Any]:
    """Return a track's message; what is not known is left out, for JSON has no NaN."""
    known = {name: value for name, value in numbers(frame, seen, true_mm).items() if math.isfinite(value)}
    return {
        "frame": seen.track.frame,
        "valid": seen.track.valid,
        "flags": list(seen.track.flag_names),
        "bus": on_bus(seen),
        **known,
        "checks": [_check(check) for check in seen.track.checks],
    }


def _profiler_points(profiler: Profiler, frame: Frame, view: ReplayView) -> npt.NDArray[np.void]:
    """Return a point (columns,) a column in the profile's frame, m; z and its sigma are NaN where unknown."""
    codes, intensity = frame.image_dn[:2]
    points = np.zeros(profiler.columns, PROFILER_POINT)
    points["y"], points["z"] = M_PER_MM * profiler.y_mm, M_PER_MM * profiler.z_mm(codes)
    points["sigma"] = M_PER_MM * profiler.own_sigmas_mm(frame.image_dn)
    points["intensity"], points["on_trace"] = intensity, np.isfinite(view.stripe_px).all(axis=1)
    return points


def _point_cloud(stamp: dict[str, int], frame_id: str, points: npt.NDArray[np.void]) -> dict[str, Any]:
    """Return the message of points (n,) whose named fields are packed."""
    fields = points.dtype.fields
    assert fields is not None
    return {
        "timestamp": stamp,
        "frame_id": frame_id,
        "pose": {"position": _named("xyz", np.zeros(3)), "orientation": _named("xyzw", np.eye(4)[3])},
        "point_stride": points.dtype.itemsize,
        "fields": [
            {"name": name, "offset": offset, "type": PACKED_TYPES[kind.str]}
            for name, (kind, offset, *_) in fields.items()
        ],
        "data": _base64(points.tobytes()),
    }


def _check(check: Check) -> dict[str, Any]:
    numbers = {"value": check.value, "limit": check.limit}
    return {
        "question": check.question.id,
        "words": check.question.words,
        "demand": check.question.demand,
        "outcome": check.outcome,
        "flag": check.flag.name,
        **{name: value for name, value in numbers.items() if math.isfinite(value)},
    }


def _annotations(stamp: dict[str, int], view: ReplayView) -> dict[str, Any]:
    """Return the stripe as lines, vermillion where it is saturated, and the seam and its truth as rings."""
    width_px = 1 if view.grey is None else view.grey.shape[1]
    lines = [
        _line(stamp, points, colour, 2.0)
        for points, colour in (
            (view.expected_px, style.SKY),
            (view.stripe_px, style.ORANGE),
            (chosen(view.stripe_px, view.saturated), style.VERMILLION),
        )
    ]
    rings = [
        {
            "timestamp": stamp,
            "position": _point(point),
            "diameter": width_px / share,
            "thickness": 2.0,
            "fill_color": _colour(colour, 0.0),
            "outline_color": _colour(colour),
        }
        for point, colour, share in ((view.seam_px, style.YELLOW, 40.0), (view.truth_px, style.GREEN, 25.0))
        if point is not None
    ]
    return {"circles": rings, "points": [line for group in lines for line in group], "texts": []}


def _line(stamp: dict[str, int], points_px: Float64, colour: str, thickness: float) -> list[dict[str, Any]]:
    """Return a line through points (n, 2), px, broken where they are NaN."""
    return [
        {
            "timestamp": stamp,
            "type": LINE_STRIP,
            "points": [_point(point) for point in stretch],
            "outline_color": _colour(colour),
            "outline_colors": [],
            "fill_color": _colour(colour, 0.0),
            "thickness": thickness,
        }
        for stretch in stretches(points_px)
    ]


def _point(point_px: Float64) -> dict[str, float]:
    # Foxglove counts from the corner of the first pixel, arctrack from its middle.
    return {"x": float(point_px[0]) + 0.5, "y": float(point_px[1]) + 0.5}


def _colour(colour: str, opacity: float = 1.0) -> dict[str, float]:
    return {**_named("rgb", [share / 255.0 for share in getrgb(colour)]), "a": opacity}


def _transform(stamp: dict[str, int], parent: str, child: str, T_parent_child: Float64) -> dict[str, Any]:
    return {
        "timestamp": stamp,
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": _named("xyz", T_parent_child[:3, 3] * M_PER_MM),
        "rotation": _named("xyzw", Rotation.from_matrix(T_parent_child[:3, :3]).as_quat()),
    }


def _named(names: str, values: Sequence[float] | Float64) -> dict[str, float]:
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def _stamp(ns: int) -> dict[str, int]:
    return {"sec": ns // 1_000_000_000, "nsec": ns % 1_000_000_000}


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
