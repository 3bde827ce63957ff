"""Hints on files that lie where frames were expected, and what to do with them."""

import os
import re
from pathlib import Path

IMPORTED = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff")
"""Pictures that `arctrack import` reads."""

LOSSY = (".jpg", ".jpeg", ".webp", ".heic")
"""Pictures whose codec has changed the noise that a frame is read by."""

VIDEOS = {".avi", ".mkv", ".mov", ".mp4", ".m4v", ".webm", ".wmv", ".mpg", ".mpeg"}

_LAST_NUMBER = re.compile(r"(\d+)\D*$")


def frame_hint(path: Path) -> str:
    """Return the cure for a frame that lies there in another format than PNG; else nothing."""
    for name in _other_formats(path, (*LOSSY, *IMPORTED)):
        suffix = os.path.splitext(name)[1].lower()
        noise = "its compression has changed the noise"
        if suffix == ".png":
            return f"; {name} is there: name it {path.name}"
        if suffix not in IMPORTED:
            return f"; {name} is there, but {noise}: record PNG"
        return f"; {name} is there: arctrack import reads it" + (
            f", though {noise}" if suffix in LOSSY else ""
        )
    other = next(iter(_other_formats(path, (".pgm", ".raw"))), None)
    return "" if other is None else f"; {other} is there: make a grey PNG of it, named {path.name}"


def number_hint(folder: Path, index: int) -> str:
    """Return the cure for a frame's PNG of another name; else nothing."""
    for name in _names(folder):
        stem, suffix = os.path.splitext(name)
        number = _LAST_NUMBER.search(stem)
        if suffix.lower() in IMPORTED and number is not None and int(number[1][-18:]) == index:
            cure = f"name it {index:06d}.png" if suffix.lower() == ".png" else "arctrack import reads it"
            return f"; {name} is there: {cure}"
    return ""


def source_hint(recording: Path, index: int) -> str:
    """Return the cure where there are neither a folder of PNGs nor a video; else nothing."""
    names = _names(recording)
    video = next((name for name in names if os.path.splitext(name)[1].lower() in VIDEOS), None)
    if video is not None:
        return f"; {video} is there: only frames.mkv is read, grey FFV1, since other codecs change the noise"
    if any(name == f"{index:06d}.png" for name in names):
        return f"; {index:06d}.png lies beside it: put the PNGs into a folder frames"
    image = next((name for name in names if _is_numbered_image(name)), None)
    return "" if image is None else f"; {image} lies beside it: arctrack import makes a recording of images"


def _other_formats(path: Path, suffixes: tuple[str, ...]) -> list[str]:
    """Return the names that a frame's file has with other suffixes, in small letters or capitals."""
    written = [letters for suffix in suffixes for letters in dict.fromkeys((suffix, suffix.upper()))]
    return [path.with_suffix(suffix).name for suffix in written if path.with_suffix(suffix).exists()]


def _is_numbered_image(name: str) -> bool:
    stem, suffix = os.path.splitext(name)
    return suffix.lower() in IMPORTED and _LAST_NUMBER.search(stem) is not None


def _names(folder: Path) -> list[str]:
    """Return the first names in a folder, sorted; none if it cannot be read."""
    try:
        with os.scandir(folder) as entries:
            # Names in a folder that are looked at for a hint.
            return sorted(entry.name for _, entry in zip(range(10_000), entries, strict=False))
    except OSError:
        return []
