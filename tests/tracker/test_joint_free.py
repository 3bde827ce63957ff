"""A free section laid onto drawn profiles: found where it says where it lies, refused where it does not."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from profiles import fit_joint, measure

from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import Joint, section
from tracker.joint.evidence import MIN_EVIDENCE_NATS

LINE = ((-100.0, 0.0, 0.0), (100.0, 0.0, 0.0))
Y_MM = np.linspace(-30.0, 30.0, 31)


def free_joint(shape: Callable[[Float64], Float64]) -> Joint:
    """A joint whose taught section has a shape z(y), mm."""
    points = tuple(
        (float(y), float(z - shape(np.zeros(1))[0])) for y, z in zip(Y_MM, shape(Y_MM), strict=True)
    )
    return Joint("free", {}, LINE, section_mm=points)


def bead(y_mm: Float64) -> Float64:
    """A smooth bead beside a shallow dip."""
    return np.asarray(1.5 * np.exp(-(((y_mm - 3.0) / 2.5) ** 2)) - 0.8 * np.exp(-(((y_mm + 4.0) / 3.0) ** 2)))


def turned(corners: Float64, deg: float) -> Float64:
    """Corners (n, 2) turned about the seam point."""
    cos, sin = math.cos(math.radians(deg)), math.sin(math.radians(deg))
    return np.ascontiguousarray(corners[1:-1] @ np.array([[cos, sin], [-sin, cos]]))


@pytest.mark.parametrize("turn_deg", [0.0, 1.5])
@pytest.mark.parametrize("is_spattered", [False, True])
def test_a_taught_section_is_found_where_it_lies(turn_deg: float, is_spattered: bool) -> None:
    joint, pulls = free_joint(bead), []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        seam = rng.uniform(-2.0, 2.0), -1.0
        profile = measure(turned(section(joint).vertices, turn_deg), seam, rng, sigma_px=0.3)
        if is_spattered:
            profile.z_mm[rng.random(len(profile.z_mm)) < 0.1] += 1.5
        found = fit_joint(profile, joint)
        assert found is not None
        assert found.evidence_nats > MIN_EVIDENCE_NATS
        off_mm = np.subtract((found.y_mm, found.z_mm), seam)
        assert np.abs(off_mm).max() < 0.1
        pulls.append(off_mm / np.sqrt(np.diag(found.covariance_mm2)))
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.4


@pytest.mark.parametrize(
    "shape",
    [
        lambda y: 0.0 * y,
        lambda y: 0.1 * y,
        lambda y: 0.004 * np.sin(y),
        lambda y: 1.5 * np.cos(math.pi * y / 2.0),
    ],
    ids=["flat", "sloped", "within the noise", "repeated"],
)
def test_a_section_that_does_not_say_where_it_lies_is_refused(shape: Callable[[Float64], Float64]) -> None:
    joint = free_joint(shape)
    profile = measure(section(joint).vertices, (0.5, 0.0), np.random.default_rng(1), sigma_px=0.3)
    found = fit_joint(profile, joint)
    assert found is None or found.evidence_nats < MIN_EVIDENCE_NATS


def test_another_section_than_the_taught_one_is_refused() -> None:
    other = section(Joint("lap", {"thickness_mm": 2.0}, LINE)).vertices
    profile = measure(other, (0.5, 0.0), np.random.default_rng(1), sigma_px=0.1)
    found = fit_joint(profile, free_joint(bead))
    assert found is None or found.evidence_nats < MIN_EVIDENCE_NATS


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"section_mm": ()}, "missing, a free joint needs it"),
        ({"section_mm": ((-1.0, 0.0), (1.0, 0.0))}, "needs 3 to 32"),
        ({"section_mm": ((-1.0, 0.0), (2.0, 0.0), (1.0, 0.0))}, "y rising"),
        ({"section_mm": ((1.0, 0.0), (2.0, 0.0), (3.0, 0.0))}, "seam point is at y = 0"),
        ({"type": "flat"}, "is of a free joint alone"),
    ],
)
def test_a_taught_section_that_cannot_be_names_its_key(changes: dict[str, object], named: str) -> None:
    stated = {
        "type": "free",
        "dimensions": {},
        "seam_in_base_mm": LINE,
        "section_mm": free_joint(bead).section_mm,
    }
    with pytest.raises(ValueError, match=rf"^\[joint\] section_mm: .*{named}"):
        Joint(**(stated | changes))
