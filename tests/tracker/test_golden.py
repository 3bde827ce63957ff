"""Stored frames give the stored stripes and seams: processors differ in the last bits only."""

from __future__ import annotations

import csv
from collections import defaultdict

import numpy as np
from golden import SEAMS, STRIPES, replay, seam_row

TOLERANCE = 1e-4
"""Pixels and millimetres."""


def test_the_golden_frames_give_the_golden_tracks() -> None:
    stripes: dict[tuple[str, str], list[tuple[int, float]]] = defaultdict(list)
    with STRIPES.open(newline="") as file:
        for row in csv.DictReader(file):
            stripes[row["case"], row["frame"]].append((int(row["scan"]), float(row["position_px"])))
    with SEAMS.open(newline="") as file:
        seams = {
            (row.pop("case"), row.pop("frame")): list(map(float, row.values()))
            for row in csv.DictReader(file)
        }
    seen = set()
    for case, track in replay():
        key = case, str(track.frame)
        seen.add(key)
        assert track.stripe is not None
        scan, position = np.array(stripes[key]).T
        np.testing.assert_allclose(
            track.stripe.position_px[scan.astype(int)], position, rtol=0.0, atol=TOLERANCE, err_msg=str(key)
        )
        np.testing.assert_allclose(seam_row(track), seams[key], rtol=0.0, atol=TOLERANCE, err_msg=str(key))
    assert seen == set(seams) == set(stripes)
