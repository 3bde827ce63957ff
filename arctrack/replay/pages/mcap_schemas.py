"""The messages of replay.mcap: Foxglove's well-known ones, as JSON schemas, and arctrack's own.

The fields of the well-known ones are those of https://docs.foxglove.dev/docs/sdk/schemas, of which only those
that are used are listed. Foxglove counts lengths in m.
"""

from typing import Any

from arctrack.replay.pages.numbers import MEANINGS

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
