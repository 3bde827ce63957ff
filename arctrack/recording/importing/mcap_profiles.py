"""Profiles in MCAP files, a message each: arctrack's own, and point clouds of ROS 2 and of Foxglove."""

import base64
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.records import Channel, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader
from mcap_ros2.decoder import DecoderFactory

from arctrack.errors import in_file
from arctrack.limits import LIMITS
from arctrack.recording.files import blamed_on, open_file
from arctrack.recording.importing.profile_layout import ProfileLayout, RawProfile

OWN_KEYS = {"topic": "/profile", "axes": "y,x,z", "up_mm": "1000", "across_mm": "1000"}
"""The keys of a file that arctrack wrote: a profiler's points are in its profile's frame, m."""

OWN_METADATA, OWN_FRAME = "arctrack", "profile"

ROS_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
FOXGLOVE_TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}
"""Types of packed numbers, by their numbers in messages."""

NO_TURN = {
    "position": {"x": 0.0, "y": 0.0, "z": 0.0},
    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
}
"""Foxglove's pose of points that are in the message's frame."""


class PointMessage(NamedTuple):
    """Points (n,) of a message, with named fields, the frame that they are in, and its stamp, s and ns."""

    points: npt.NDArray[np.void]
    frame: str
    stamp: tuple[int, int]


Decoder = Callable[[bytes], PointMessage]


def known_keys(path: Path) -> Mapping[str, str]:
    """Return the keys of --profile that a file need not be asked for: those of arctrack's own."""
    return {} if _own_metadata(path) is None else OWN_KEYS


def mcap_profiles(path: Path, layout: ProfileLayout) -> Iterator[RawProfile]:
    """Yield the profile of each message of a topic, at the time of its stamp.

    Times in a file that arctrack wrote are those of the recording or run. ArctrackError names the topic.
    """
    own = _own_metadata(path)
    late_s = 0.0 if own is None else float(own["seconds_later"])
    topic, decode, channels = _topic(path, layout)
    messages = (each for each in _records(path) if isinstance(each, Message) and each.channel_id in channels)
    n = 0
    for n, message in enumerate(messages, 1):
        try:
            points, frame, (seconds, ns) = decode(message.data)
        except ValueError as error:
            raise in_file(path, f"message {n} of topic {topic}: {error}") from None
        if own is not None and frame != OWN_FRAME:
            raise in_file(path, f"topic {topic} holds what was read in images: import the images instead")
        names = points.dtype.names or ()
        across, _, up = (names[place] for place in layout.axes(path, names))
        known = points[np.isfinite(points[across])].astype([(name, "f8") for name in names])
        intensity = known["intensity"] if "intensity" in names else None
        field = "sigma" if own is not None and "sigma" in names else layout.sigma_field(path, names)
        sigma = None if field is None else known[field]
        yield RawProfile(known[across], known[up], intensity, sigma, seconds - late_s + 1e-9 * ns)
    if n == 0:
        raise in_file(path, f"topic {topic} holds no message: choose another by --profile topic=…")


def _records(path: Path) -> Iterator[McapRecord]:
    """Yield a file's records in order, as many as are whole of one that was broken off.

    Whatever its bytes make of it else is an ArctrackError.
    """
    with blamed_on(path), open_file(path, LIMITS.log_bytes) as file:
        try:
            yield from StreamReader(file).records
        except OSError:
            raise
        # Damaged bytes make errors of any kind in the decompression and the decoding.
        except Exception as error:
            # A file that was broken off ends amid a record.
            if file.tell() <= MAGIC_SIZE or file.read(1):
                reason = str(error) or type(error).__name__
                raise in_file(path, f"is damaged, or no MCAP file: {reason}") from None


def _own_metadata(path: Path) -> Mapping[str, str] | None:
    """Return what arctrack says of a file that it wrote, None of another's; it stands before the messages."""
    for record in _records(path):
        if isinstance(record, Metadata) and record.name == OWN_METADATA:
            metadata: Mapping[str, str] = record.metadata
            return metadata
        if isinstance(record, Message):
            break
    return None


def _topic(path: Path, layout: ProfileLayout) -> tuple[str, Decoder, set[int]]:
    """Return the topic that is stated, or the only one that has point clouds, its decoder and channels."""
    schemas: dict[int, Schema] = {}
    decoders: dict[str, Decoder] = {}
    channels: dict[str, set[int]] = {}
    for record in _records(path):
        if isinstance(record, Schema):
            schemas[record.id] = record
        if isinstance(record, Channel):
            decoder = _decoder(record.message_encoding, schemas.get(record.schema_id))
            if decoder is not None:
                decoders[record.topic] = decoder
                channels.setdefault(record.topic, set()).add(record.id)
    if not decoders:
        kinds = "sensor_msgs/msg/PointCloud2 in CDR with ros2msg, foxglove.PointCloud in JSON"
        raise in_file(path, f"has no topic of point clouds that are read: {kinds}")
    topic = layout.stated.get("topic", next(iter(decoders)) if len(decoders) == 1 else None)
    if topic is None or topic not in decoders:
        problem = "has several topics of point clouds" if topic is None else f"has no point clouds of {topic}"
        raise in_file(path, f"{problem}: give --profile topic= one of {', '.join(sorted(decoders))}")
    return topic, decoders[topic], channels[topic]


def _decoder(encoding: str, schema: Schema | None) -> Decoder | None:
    """Return the decoder of a topic's messages, None if they are no point clouds that are read."""
    if schema is None:
        return None
    if (schema.name, encoding) == ("foxglove.PointCloud", "json"):
        return _foxglove
    decode = DecoderFactory().decoder_for(encoding, schema)
    if schema.name != "sensor_msgs/msg/PointCloud2" or decode is None:
        return None
    return lambda data: _ros(decode(data))


def _foxglove(data: bytes) -> PointMessage:
    message = json.loads(data)
    if message.get("pose", NO_TURN) != NO_TURN:
        raise ValueError("its points have a pose of their own: publish them in the profile's frame")
    fields = [(field["name"], field["offset"], FOXGLOVE_TYPES[field["type"]]) for field in message["fields"]]
    points = _unpacked(base64.b64decode(message["data"]), fields, message["point_stride"], "<")
    stamp = message["timestamp"]
    return PointMessage(points, message["frame_id"], (stamp["sec"], stamp["nsec"]))


def _ros(message: Any) -> PointMessage:
    if message.height > 1 and message.width > 1:
        raise ValueError(f"holds {message.height} rows of points: publish a message a profile")
    fields = [
        (field.name, field.offset, ROS_TYPES[field.datatype]) for field in message.fields if field.count == 1
    ]
    order = ">" if message.is_bigendian else "<"
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.row_step)
    data = rows[:, : message.width * message.point_step].tobytes()
    stamp = message.header.stamp
    points = _unpacked(data, fields, message.point_step, order)
    return PointMessage(points, message.header.frame_id, (stamp.sec, stamp.nanosec))


def _unpacked(
    data: bytes, fields: Sequence[tuple[str, int, str]], stride: int, order: str
) -> npt.NDArray[np.void]:
    """Return points (n,) of packed numbers: each field has a name, an offset and a type."""
    names, offsets, types = zip(*fields, strict=True)
    formats = [f"{order}{each}" for each in types]
    kind = np.dtype({"names": names, "offsets": offsets, "formats": formats, "itemsize": stride})
    return np.frombuffer(data, kind)
