"""The same corners through mrcal, where it is installed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed: it has wheels for Python 3.12 and 3.13 alone")

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.parametrize("seed", range(4))
def test_mrcal_sees_the_same_and_knows_it_as_well(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    camera_mrcal, camera_worlds = (__import__(name) for name in ("camera_mrcal", "camera_worlds"))
    rng = np.random.default_rng(seed)
    world = camera_worlds.draw_world(rng, "k1 k2 p1 p2")
    world.sigma_px[:] = 0.1
    result = camera_mrcal.compare(world, camera_worlds.draw_corners(rng, world)[0])
    assert np.linalg.norm(result.apart_px, axis=1).max() < 0.1
    assert result.ours_px / result.theirs_px == pytest.approx(1.0, abs=0.2)
