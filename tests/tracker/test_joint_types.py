"""Every type of joint on profiles cut from sections drawn by hand: what is read, and how sure it is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import profiles
import pytest
from profiles import fit_joint, groove, lap, measure, only

from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import Joint
from tracker.joint import MeasuredJoint
from tracker.joint.common_mode import COMMON_MODE_PX
from tracker.joint.evidence import MIN_EVIDENCE_NATS
from tracker.joint.section_fit import SIGMA_FLOOR_PX
from tracker.pipeline import MAX_COVERED_MM

LINE = ((-100.0, 0.0, 0.0), (100.0, 0.0, 0.0))
SIGMA_PX = 0.07
TRUE_SIGMA_PX = float(np.hypot(SIGMA_PX, SIGMA_FLOOR_PX))
FAR_MM = 60.0
OUT_OF_VIEW_MM = 20.0
PROFILES, TACKS = 400, 200
SURE_SIGMAS = 4.0
"""No seam is off by more, unless it is refused."""


@dataclass(frozen=True)
class Truth:
    """A drawn section: corners (n, 2) about the seam point, and the dimensions that it has (NaN: none)."""

    corners: Float64
    gap_mm: float = math.nan
    mismatch_mm: float = math.nan
    bevels_deg: tuple[float, float] = (math.nan, math.nan)
    plates_deg: tuple[float, float] = (math.nan, math.nan)
    area_mm2: float = math.nan


def plates(right: tuple[float, float], left: tuple[float, float], tilts_deg: tuple[float, float]) -> Float64:
    """The far ends of a left and a right plate, which begin at the given corners."""
    rise_left, rise_right = (math.tan(math.radians(tilt)) for tilt in tilts_deg)
    return np.array(
        [
            (right[0] - FAR_MM, right[1] - rise_right * FAR_MM),
            (left[0] + FAR_MM, left[1] + rise_left * FAR_MM),
        ]
    )


def with_plates(inner: list[tuple[float, float]], tilts_deg: tuple[float, float]) -> Float64:
    ends = plates(inner[0], inner[-1], tilts_deg)
    return np.array([ends[0], *inner, ends[1]])


def shoelace(points: list[tuple[float, float]]) -> float:
    y, z = np.transpose(points)
    return float(0.5 * np.sum(y * np.roll(z, -1) - np.roll(y, -1) * z))


def v_groove(rng: np.random.Generator) -> Truth:
    bevels = tuple(30.0 + rng.normal(0.0, 1.0, 2))
    depths, gap = tuple(4.0 + rng.normal(0.0, 0.2, 2)), 1.0 + rng.normal(0.0, 0.15)
    corners = groove(bevels, depths, gap)
    return Truth(corners, gap, depths[0] - depths[1], bevels, (0.0, 0.0), shoelace(list(corners[1:-1])))


def lap_joint(rng: np.random.Generator) -> Truth:
    step, tilts = 2.05 + rng.uniform(0.0, 0.35), rng.normal(0.0, 0.5, 2)
    slopes = np.tan(np.radians(tilts))
    return Truth(lap(step, slopes[0], slopes[1]), step - 2.0, -step, plates_deg=tuple(tilts))


def butt(rng: np.random.Generator) -> Truth:
    gap, mismatch, tilts = 1.2 + rng.uniform(-0.3, 0.3), rng.normal(0.0, 0.1), tuple(rng.normal(0.0, 0.5, 2))
    left, right = 0.5 * gap, -0.5 * gap
    high, low = 0.5 * mismatch, -0.5 * mismatch
    inner = [(right, low), (right, -3.0), (left, -3.0), (left, high)]
    return Truth(with_plates(inner, tilts), gap, mismatch, plates_deg=tilts, area_mm2=gap * 3.0)


def edge(rng: np.random.Generator) -> Truth:
    gap, mismatch = 0.6 + rng.uniform(-0.1, 0.1), rng.normal(0.0, 0.1)
    left, right, low = 0.5 * gap, -0.5 * gap, -60.0
    inner = [(right - 4.0, low), (right - 4.0, -0.5 * mismatch), (right, -0.5 * mismatch), (right, low)]
    inner += [(left, low), (left, 0.5 * mismatch), (left + 4.0, 0.5 * mismatch), (left + 4.0, low)]
    return Truth(with_plates(inner, (0.0, 0.0)), gap, mismatch, plates_deg=(0.0, 0.0))


def half_v(rng: np.random.Generator) -> Truth:
    bevel, gap = 45.0 + rng.normal(0.0, 1.0), 1.0 + rng.normal(0.0, 0.15)
    depths, tilts = 4.0 + rng.normal(0.0, 0.2, 2), tuple(rng.normal(0.0, 0.5, 2))
    mouth = 0.5 * gap + depths[0] * math.tan(math.radians(bevel))
    inner = [(-0.5 * gap, depths[1]), (-0.5 * gap, 0.0), (0.5 * gap, 0.0), (mouth, depths[0])]
    bevels = (bevel, math.nan)
    return Truth(with_plates(inner, tilts), gap, depths[0] - depths[1], bevels, tilts, shoelace(inner))


def u_groove(rng: np.random.Generator) -> Truth:
    """The rounding as points on its circle, far closer together than the columns."""
    bevels, radius = 20.0 + rng.normal(0.0, 1.0, 2), 3.0 + rng.normal(0.0, 0.1)
    gap, depths = 1.0 + rng.normal(0.0, 0.15), 6.0 + rng.normal(0.0, 0.2, 2)
    sides = []
    for bevel_deg, depth in zip(bevels, depths, strict=True):
        bevel = math.radians(bevel_deg)
        turn = np.linspace(0.0, 0.5 * math.pi - bevel, 400)
        side = [(0.5 * gap + radius * math.sin(t), radius * (1.0 - math.cos(t))) for t in turn]
        over = depth - side[-1][1]
        sides.append([*side, (side[-1][0] + over * math.tan(bevel), depth)])
    inner = [(-y, z) for y, z in reversed(sides[1])] + sides[0]
    return Truth(
        with_plates(inner, (0.0, 0.0)), gap, depths[0] - depths[1], tuple(bevels), (0.0, 0.0), shoelace(inner)
    )


def corner(half_deg: float) -> Callable[[np.random.Generator], Truth]:
    def drawn(rng: np.random.Generator) -> Truth:
        tilts = tuple(rng.normal(0.0, 1.5, 2) + np.array([90.0 - half_deg, half_deg - 90.0]))
        return Truth(with_plates([(0.0, 0.0)], tilts), plates_deg=tilts)

    return drawn


SIZE_V = {"included_angle_deg": 60.0, "depth_mm": 4.0, "root_gap_mm": 1.0}
SIZE_U = {"depth_mm": 6.0, "root_radius_mm": 3.0, "bevel_angle_deg": 20.0, "root_gap_mm": 1.0}
CASES = {
    "v_groove": (Joint("v_groove", SIZE_V, LINE), v_groove),
    "lap": (Joint("lap", {"thickness_mm": 2.0}, LINE), lap_joint),
    "butt": (Joint("butt", {"gap_mm": 1.2, "thickness_mm": 3.0}, LINE), butt),
    "edge": (Joint("edge", {"gap_mm": 0.6, "thickness_mm": 4.0}, LINE), edge),
    "half_v": (
        Joint("half_v", {"bevel_angle_deg": 45.0, "depth_mm": 4.0, "root_gap_mm": 1.0}, LINE),
        half_v,
    ),
    "u_groove": (Joint("u_groove", SIZE_U, LINE), u_groove),
    "fillet": (Joint("fillet", {"included_angle_deg": 90.0}, LINE), corner(45.0)),
    "wide fillet": (Joint("fillet", {"included_angle_deg": 120.0}, LINE), corner(60.0)),
    "ridge": (Joint("fillet", {"included_angle_deg": 250.0}, LINE), corner(125.0)),
}


OVERSTATED = {("edge", "y"): 1.65, ("edge", "gap"): 1.65}
"""By how much the sigma of what ends columns tell is too wide where no column of a face is ever missed.

The four columns in this gap may be missed by the sheet itself, at the rate of Jeffreys' prior: behind 57 that
are seen, the posterior of its end has 1.63 times the deviation of one column (`change_of_faces`).
"""


def seen(truth: Truth, seam: tuple[float, float], rng: np.random.Generator):
    """A profile of a drawn section, seen from straight above; what lies far below is out of view."""
    profile = measure(truth.corners, seam, rng, sigma_px=TRUE_SIGMA_PX, common_px=COMMON_MODE_PX)
    profile.sigma_px[:] = SIGMA_PX
    return only(profile, profile.z_mm > seam[1] - OUT_OF_VIEW_MM)


def fit(profile, joint: Joint, seam: tuple[float, float]) -> MeasuredJoint | None:
    camera, laser = np.array([60.0, seam[0], 130.0]), np.array([0.0, seam[0], 140.0])
    return fit_joint(profile, joint, camera, laser)


def misses(found: MeasuredJoint, truth: Truth, seam: tuple[float, float]) -> dict[str, tuple[float, float]]:
    """Errors and their stated sigma by name; without what the joint has not."""
    sigma_y, sigma_z = np.sqrt(np.diag(found.covariance_mm2))
    shape = found.shape
    pairs = {
        "y": (found.y_mm - seam[0], sigma_y),
        "z": (found.z_mm - seam[1], sigma_z),
        "gap": (found.gap_mm - truth.gap_mm, shape.gap_sigma_mm),
        "mismatch": (found.mismatch_mm - truth.mismatch_mm, shape.mismatch_sigma_mm),
        "bevel left": (shape.bevel_angles_deg[0] - truth.bevels_deg[0], shape.bevel_sigmas_deg[0]),
        "bevel right": (shape.bevel_angles_deg[1] - truth.bevels_deg[1], shape.bevel_sigmas_deg[1]),
        "plate left": (shape.plate_angles_deg[0] - truth.plates_deg[0], shape.plate_sigmas_deg[0]),
        "plate right": (shape.plate_angles_deg[1] - truth.plates_deg[1], shape.plate_sigmas_deg[1]),
        "area": (shape.area_mm2 - truth.area_mm2, shape.area_sigma_mm2),
    }
    return {name: pair for name, pair in pairs.items() if math.isfinite(pair[0])}


@pytest.mark.parametrize("gap_mm", [0.0, 0.3])
@pytest.mark.parametrize("thickness_mm", [0.6, 0.7, 1.0])
def test_beyond_a_thin_sheet_there_is_no_gap(
    monkeypatch: pytest.MonkeyPatch, thickness_mm: float, gap_mm: float
) -> None:
    """Of an edge joint of sheets narrower than twice the range in which their ends are looked for."""
    monkeypatch.setattr(profiles, "COLUMN_MM", 0.035)
    joint = Joint("edge", {"gap_mm": gap_mm, "thickness_mm": thickness_mm}, LINE)
    right, left, low = -0.5 * gap_mm, 0.5 * gap_mm, -60.0
    inner = [(right - thickness_mm, low), (right - thickness_mm, 0.0), (right, 0.0)]
    inner += [(right, low), (left, low)] if gap_mm else []
    inner += [(left, 0.0), (left + thickness_mm, 0.0), (left + thickness_mm, low)]
    truth = Truth(with_plates(inner, (0.0, 0.0)), gap_mm, 0.0, plates_deg=(0.0, 0.0))
    found = fit(seen(truth, (0.5, -0.2), np.random.default_rng(3)), joint, (0.5, -0.2))
    assert found is not None
    assert found.gap_mm == pytest.approx(gap_mm, abs=0.08)
    assert found.y_mm == pytest.approx(0.5, abs=0.08)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_every_dimension_is_unbiased_and_its_sigma_honest(name: str) -> None:
    joint, draw = CASES[name]
    rng = np.random.default_rng(8)
    errors: dict[str, list[tuple[float, float]]] = {}
    flagged = 0
    for _ in range(PROFILES):
        seam = (rng.uniform(-4.0, 4.0), rng.uniform(-2.0, 2.0))
        truth = draw(rng)
        found = fit(seen(truth, seam, rng), joint, seam)
        assert found is not None
        if found.misfit_nats > MIN_EVIDENCE_NATS:
            flagged += 1
            continue
        for key, pair in misses(found, truth, seam).items():
            errors.setdefault(key, []).append(pair)
    wanted = {"y", "z"}
    for key, pairs in errors.items():
        error, sigma = np.transpose(pairs)
        chi2, bias = float(np.mean((error / sigma) ** 2)), float(error.mean())
        bound = float(np.sqrt(np.mean(sigma**2)))
        print(
            f"{name:12} {key:12} chi2 {chi2:.3f}, rms {error.std():.5f}, bias {bias:+.5f}, sigma {bound:.5f}"
        )
        assert len(pairs) == PROFILES - flagged
        wanted.discard(key)
        assert 0.8 < chi2 * OVERSTATED.get((name, key), 1.0) ** 2 < 1.25, key
        assert abs(bias) < bound / 3.0, key
    assert not wanted
    assert flagged <= 0.01 * PROFILES


def tack_over(truth: Truth, name: str, rng: np.random.Generator) -> Callable[[Float64], Float64]:
    """The height (n,) of a tack's smooth bead beside the seam, mm; low outside of it.

    In a groove it covers 30 to 60 % of the mouth; of the others it stands over edge or corner.
    """
    inner = truth.corners[1:-1]
    if name in ("v_groove", "half_v", "u_groove"):
        width = rng.uniform(0.3, 0.6) * (inner[-1, 0] - inner[0, 0])
        left_out = 0.5 * (inner[-1, 0] - inner[0, 0] - width)
        middle = 0.5 * (inner[-1, 0] + inner[0, 0]) + rng.uniform(-left_out, left_out)
    else:
        width, middle = rng.uniform(1.5, 4.0), rng.uniform(-0.5, 0.5)
    ends = middle + 0.5 * width * np.array([-1.0, 1.0])
    foot = np.interp(ends, truth.corners[:, 0], truth.corners[:, 1])
    if name in ("butt", "edge"):
        foot = np.full(2, -0.3)
    crown = rng.uniform(0.3, 1.5)

    def height(y: Float64) -> Float64:
        share = np.clip((y - ends[0]) / width, 0.0, 1.0)
        bead = (1.0 - share) * foot[0] + share * foot[1] + 4.0 * crown * share * (1.0 - share)
        return np.where((y > ends[0]) & (y < ends[1]), bead, -np.inf)

    return height


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_seam_beside_a_tack_is_right_or_refused(name: str) -> None:
    joint, draw = CASES[name]
    rng = np.random.default_rng(9)
    refused, scaled = 0, []
    for _ in range(TACKS):
        seam = (rng.uniform(-3.0, 3.0), rng.uniform(-1.0, 1.0))
        truth = draw(rng)
        profile = seen(truth, seam, rng)
        beside = profile.y_mm - seam[0]
        lifted = tack_over(truth, name, rng)(beside)
        bare = np.interp(beside, truth.corners[:, 0], truth.corners[:, 1])
        profile.z_mm[:] += np.maximum(lifted - bare, 0.0)
        found = fit(profile, joint, seam)
        if found is None or found.covered_mm > MAX_COVERED_MM:
            refused += 1
            continue
        error = np.array([found.y_mm - seam[0], found.z_mm - seam[1]])
        off = np.abs(error) / np.sqrt(np.diag(found.covariance_mm2))
        # A right seam is off by three sigmas in one of 370: of all these tacks here, somewhere.
        assert (off < SURE_SIGMAS).all(), (name, error, found)
        scaled.append(off**2)
    print(f"{name}: {refused} of {TACKS} tacks hide the joint")
    # Plates that meet, and bevels, do so under a tack too.
    if name in ("v_groove", "u_groove", "fillet", "wide fillet", "ridge"):
        assert refused < 0.05 * TACKS
    else:
        assert refused > 0.6 * TACKS
    # And on the whole by what is stated; few may be all that is left.
    assert not scaled or (np.mean(scaled, axis=0) < 1.0 + 5.0 * math.sqrt(2.0 / len(scaled))).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["v_groove", "u_groove", "half_v"])
def test_a_bevel_that_is_not_seen_is_bridged_honestly(name: str) -> None:
    """Dimensions as far off the stated ones as the fit takes them to be: gap and depths by 0.3 mm."""
    joint, _ = CASES[name]
    rng = np.random.default_rng(10)
    scaled, errors, sigmas, none = [], [], [], 0
    while len(scaled) < PROFILES:
        seam = (rng.uniform(-3.0, 3.0), rng.uniform(-1.0, 1.0))
        gap = 1.0 + rng.normal(0.0, 0.3)
        if gap <= 0.0:
            continue
        truth = with_dimensions(name, gap, rng)
        profile = seen(truth, seam, rng)
        # The left bevel is in the dark, its plate is not.
        inner = truth.corners[1:-1]
        beside = profile.y_mm - seam[0]
        dark = (beside > 0.4 * gap) & (beside < inner[-1, 0])
        found = fit(only(profile, ~dark), joint, seam)
        if found is None:
            none += 1
            continue
        error = np.array([found.y_mm - seam[0], found.z_mm - seam[1]])
        errors.append(error)
        sigmas.append(np.sqrt(np.diag(found.covariance_mm2)))
        scaled.append(error @ np.linalg.solve(found.covariance_mm2, error) / 2.0)
    chi2, bias = np.mean((np.array(errors) / sigmas) ** 2, axis=0), np.mean(errors, axis=0)
    bound = np.sqrt(np.mean(np.square(sigmas), axis=0))
    print(f"{name}: chi2 of y, z {chi2}, bias {bias} mm, sigma {bound} mm; {none} not found")
    # A narrow root beside the dark shows too little of a half V.
    assert none < 0.1 * PROFILES
    # A variance that holds a tack over the root, which is rare, is too large for the others.
    assert ((chi2 > 0.7) & (chi2 < 1.25)).all()
    assert (np.abs(bias) < bound / 3.0).all()


def with_dimensions(name: str, gap: float, rng: np.random.Generator) -> Truth:
    """A groove of a gap, its other dimensions as `CASES` draws them."""
    _, draw = CASES[name]
    truth = draw(rng)
    move = np.where(truth.corners[:, 0] > 0.0, 0.5, -0.5) * (gap - truth.gap_mm)
    return replace(truth, corners=truth.corners + np.column_stack([move, np.zeros(len(move))]), gap_mm=gap)
