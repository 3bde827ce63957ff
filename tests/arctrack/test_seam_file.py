"""arctrack-seam/1: what is written is read back, and what is wrong is refused in one line."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arctrack.errors import ArctrackError
from arctrack.recording.seam_file import KeptSeam, read_seam, write_seam

places = st.floats(-1e7, 1e7)
sigmas = st.floats(1e-9, 1e3)
measured = st.one_of(st.just(math.nan), st.floats(-1e6, 1e6))
angles = st.floats(-math.pi, math.pi)


@st.composite
def seams(draw: st.DrawFn) -> KeptSeam:
    n = draw(st.integers(2, 5))

    def array(values: st.SearchStrategy[float], *shape: int) -> np.ndarray:
        count = math.prod((n, *shape))
        drawn = draw(st.lists(values, min_size=count, max_size=count))
        return np.array(drawn).reshape(n, *shape)

    half = 0.5 * array(angles)
    return KeptSeam(
        kept_at=draw(st.datetimes(timezones=st.just(UTC))),
        calibration=draw(st.text("0123456789abcdef", min_size=12, max_size=12)),
        calibration_sigma_mm=(draw(sigmas), draw(sigmas)),
        points_base_mm=array(places, 3),
        quaternions_xyzw=np.column_stack([np.sin(half), np.zeros((n, 2)), np.cos(half)]),
        sigmas_mm=array(sigmas, 2),
        gaps_mm=array(measured),
        areas_mm2=array(measured),
    )


@given(seams())
def test_a_seam_is_read_back_the_same(seam: KeptSeam) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "seam.json"
        write_seam(path, seam)
        read = read_seam(path)
    for name, value in vars(seam).items():
        np.testing.assert_array_equal(getattr(read, name), value, err_msg=name)


@pytest.fixture
def written(tmp_path: Path) -> Path:
    path = tmp_path / "seam.json"
    write_seam(
        path,
        KeptSeam(
            kept_at=datetime(2026, 1, 2, tzinfo=UTC),
            calibration="0123456789ab",
            calibration_sigma_mm=(0.1, 0.2),
            points_base_mm=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
            quaternions_xyzw=np.tile((0.0, 0.0, 0.0, 1.0), (2, 1)),
            sigmas_mm=np.full((2, 2), 0.03),
            gaps_mm=np.array([1.0, math.nan]),
            areas_mm2=np.array([math.nan, 20.0]),
        ),
    )
    return path


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda seam: seam.update(format="arctrack-found/1"), "format"),
        (lambda seam: seam.pop("calibration"), "calibration: missing"),
        (lambda seam: seam.update(points_base_mm=seam["points_base_mm"][:1]), "points_base_mm"),
        (lambda seam: seam.update(sigmas_mm=seam["sigmas_mm"][:1]), "sigmas_mm: has 1 stations"),
        (lambda seam: seam["sigmas_mm"].__setitem__(1, [0.0, 0.1]), "sigmas_mm"),
        (lambda seam: seam["quaternions_xyzw"].__setitem__(1, [0, 0, 0, 2]), "quaternions_xyzw"),
        (lambda seam: seam["points_base_mm"].__setitem__(1, [0, 0]), "points_base_mm"),
        (lambda seam: seam["gaps_mm"].__setitem__(0, "wide"), "gaps_mm"),
        (lambda seam: seam.update(gap=[1.0]), "gap"),
        (lambda seam: seam.update(kept_at="2026-01-02T00:00:00"), "kept_at"),
    ],
)
def test_a_file_that_is_wrong_is_refused_by_its_key(written: Path, change: object, words: str) -> None:
    seam = json.loads(written.read_text())
    change(seam)
    written.write_text(json.dumps(seam))
    with pytest.raises(ArctrackError, match=words) as raised:
        read_seam(written)
    assert str(raised.value).startswith(str(written))


def test_a_file_that_is_cut_off_or_missing_is_refused(written: Path) -> None:
    written.write_text(written.read_text()[:200])
    with pytest.raises(ArctrackError, match=r"seam\.json"):
        read_seam(written)
    written.unlink()
    with pytest.raises(ArctrackError, match="keep_seam"):
        read_seam(written)
