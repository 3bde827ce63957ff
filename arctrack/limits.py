"""Limits of what arctrack reads: each with its unit, what it bounds and where it comes from.

A file beyond a limit is refused in one line before its content takes memory.
"""

from __future__ import annotations

from dataclasses import dataclass

from robot_io.stated_limit import stated

MIB = 2**20


@dataclass(frozen=True)
class Limits:
    """The limits on what is read. Each field's metadata states `unit`, `role` and `source`."""

    toml_bytes: int = stated(
        MIB, "bytes", "size of recording.toml", "a setup is 3 kB, with a filter curve of 2000 samples 50 kB"
    )
    toml_depth: int = stated(
        32, "keys", "how deep tables of recording.toml are nested", "the format nests 3 deep"
    )
    csv_bytes: int = stated(
        256 * MIB, "bytes", "size of a CSV file", "2 million poses of 82 bytes are 164 MB"
    )
    csv_rows: int = stated(
        2_000_000, "rows", "rows of a CSV file, poses of a CAN log", "poses at 250 Hz for two hours"
    )
    json_bytes: int = stated(
        64 * MIB,
        "bytes",
        "size of a pass's seam, of a file of a blind check",
        "a seam of 10 m is 2.5 MB, the labels of 100 recordings are 0.1 MB",
    )
    log_bytes: int = stated(
        1024 * MIB,
        "bytes",
        "size of a CAN log, of an MCAP file",
        "an .asc of a bus at 1 Mbit/s fills it in half an hour",
    )
    image_px: int = stated(
        2**24, "px", "pixels of the camera", "the tracker's tables take 80 bytes a pixel: 1.3 GB"
    )
    side_px: int = stated(16_384, "px", "width and height of the camera", "a line camera's 16k")
    png_bytes_per_px: int = stated(
        8, "bytes", "size of a PNG, per pixel of the camera", "16 bits in four channels, not compressed"
    )
    spare_bytes: int = stated(
        MIB, "bytes", "what a PNG or a video may hold beside its pixels", "headers, an index, texts"
    )
    video_bytes_per_byte: int = stated(
        2, "bytes", "size of frames.mkv, per byte of raw frames", "FFV1 makes noise a tenth larger at most"
    )
    frame_number: int = stated(999_999_999, "", "number of a frame", "nine digits of a file's name")
    time_s: float = stated(1e11, "s", "distance of a time from 0", "Unix seconds are 1.7e9, a log holds 1e11")
    exposure_s: float = stated(3600.0, "s", "exposure of a frame", "an hour; longer ones are in other units")
    current_a: float = stated(1e4, "A", "current of a frame", "welding sources end at 2000 A")
    length_mm: float = stated(1e7, "mm", "size of a coordinate in base", "ten kilometres")


LIMITS = Limits()
"""Those in force."""


def source_of(limit: str) -> str:
    """Return a limit's source."""
    source: str = Limits.__dataclass_fields__[limit].metadata["source"]
    return source


def size_problem(width: int, height: int) -> str | None:
    """Return the problem of a camera's size, None if its tables fit into memory."""
    if width > LIMITS.side_px or height > LIMITS.side_px:
        return f"{width} x {height} px: a side has {LIMITS.side_px} px at most"
    if width * height > LIMITS.image_px:
        most = f"{LIMITS.image_px / 1e6:.1f} million px are the most; bin or crop the image"
        return f"{width} x {height} px are {width * height / 1e6:.1f} million: {most}"
    return None
