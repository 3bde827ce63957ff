"""Poses in the files that controllers keep their points in, one after another as they stand there.

ABB: robtargets of RAPID, `[[x,y,z],[q1,q2,q3,q4],…]`; frames of tools and work objects, which end with the
rotation within a larger structure, are none. KUKA: structures of KRL, `{X 1,Y 2,Z 3,A 4,B 5,C 6,…}`, in a
`.dat` or `.src`. FANUC: the section /POS of an `.ls`, `X = 1.000 mm, … R = 6.000 deg`. UR: poses of URScript,
`p[x, y, z, rx, ry, rz]`. (Source: modules and listings of each controller in public repositories.)
"""

import re
from bisect import bisect_left
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from arctrack.recording.files import UnfitFileError
from noise_model.compiled.arrays import Float64, Int64

_NUMBER = r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*"


def _pattern(text: str) -> re.Pattern[str]:
    return re.compile(text.replace("N", _NUMBER), re.IGNORECASE | re.MULTILINE)


def _fields(names: str, form: str, between: str) -> str:
    return between.join(form.format(name) for name in names)


_POSES = {
    "abb": _pattern(r"\[\s*\[N,N,N\]\s*,\s*\[N,N,N,N\](?=\s*(?:,\s*\[|\]\s*\"?\s*;?\s*$))"),
    "kuka": _pattern(r"\{[^{}]*?" + _fields("XYZABC", r"\s*{}\s+N", ",")),
    "fanuc": _pattern(_fields("XYZ", r"\s*{}\s*=Nmm", ",") + "," + _fields("WPR", r"\s*{}\s*=Ndeg", ",")),
    "ur": _pattern(r"\bp\[N,N,N,N,N,N\]"),
}
_POINTS = {
    "abb": re.compile(r"\brobtarget\s+\w+\s*(?:\{\d+\})?\s*:=", re.IGNORECASE),
    "kuka": re.compile(r"\bE6POS\s+\w+\s*=", re.IGNORECASE),
    "fanuc": re.compile(r"\bP\[\d+[^\]]*\]\s*\{", re.IGNORECASE),
    # A pose in another pose's frame is none in base.
    "ur": re.compile(r"\bp\[|\bpose_(?:trans|add)\s*\("),
}
"""The begin of a point of a listing, whether or not its pose can be read."""

_NO_POINTS = {
    "abb": re.compile(r"!.*"),
    "kuka": re.compile(
        r"^[ \t]*;.*|(?:\$\w+|\w+_DATA)\s*(?:\[\w+\])?\s*=\s*\{[^{}]*\}|\w+_REL\s*\{[^{}]*\}",
        re.MULTILINE | re.IGNORECASE,
    ),
    "ur": re.compile(r"#.*|\bset_tcp\s*\(\s*p\[[^\]]*\]"),
}
"""No points of a path: remarks, frames of tools and bases, steps from one point to the next."""

LISTED = tuple(_POSES)
"""The controllers whose listings are read."""

LISTING_SUFFIXES = (".ls", ".mod", ".pgf", ".prg", ".script", ".src", ".sys", ".va")
"""Names of files that are controllers' programs, and no tables."""


@dataclass(frozen=True)
class ListedPoses:
    """Poses of a listing.

    `numbers` (n, 6 or 7) are position and rotation as the controller writes them, `lines` (n,) where they
    stand, `before` what stands before each on its line: a time, an image's name, or the program.
    """

    numbers: Float64
    lines: Int64
    before: tuple[str, ...]


def find_poses(text: str, rotation: str) -> ListedPoses | None:
    """Return the poses of a controller's listing, None if a text holds none.

    UnfitFileError for a point that is no pose: FANUC's may be angles of joints.
    """
    if rotation in _NO_POINTS:
        text = _NO_POINTS[rotation].sub(lambda match: "\n" * match[0].count("\n"), text)
    poses = list(_POSES[rotation].finditer(text))
    points = [point.start() for point in _POINTS[rotation].finditer(text)]
    starts = [pose.start() for pose in poses]
    for start, end in pairwise([*points, len(text)]):
        if bisect_left(starts, start) == bisect_left(starts, end):
            line = 1 + text.count("\n", 0, start)
            raise UnfitFileError("a point without a pose: show it in Cartesian coordinates", line)
    if not poses:
        return None
    ends_of_lines = [end.start() for end in re.finditer("\n", text)]
    return ListedPoses(
        np.array([[float(number) for number in pose.groups()] for pose in poses]),
        np.array([1 + bisect_left(ends_of_lines, start) for start in starts]),
        tuple(text[text.rfind("\n", 0, start) + 1 : start].strip(' \t";,') for start in starts),
    )
