"""Any frame, pose and small setup: a step never raises, and whatever it does not know is NaN under a flag."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any, TypeGuard

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rendered import pose_at, rolled

from arctrack.nominal import DIMENSIONS, nominal_setup
from arctrack.simulation.simulate import balance
from noise_model.condition import Condition
from noise_model.effects import REGISTRY
from noise_model.forward import draw_frame
from noise_model.setup import Setup
from noise_model.surface.joint import Joint, SeamLine
from tracker import flags
from tracker.state import Frame, Pose, Track
from tracker.tracker import Tracker

KINDS = ("noise", "black", "white", "flat", "random", "blocks", "rows", "columns", "salt", "half")
MIN_PX, MAX_PX = 16, 120
MATERIALS = ("mild_steel", "zn_coated")

odd_numbers = st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-12, 1e12])
turns_deg = st.floats(-180.0, 180.0)
shifts_mm = st.one_of(st.floats(-20.0, 20.0), st.floats(-500.0, 500.0), st.sampled_from([1e5, -1e9, 139.99]))


def flat(setup: Setup) -> Setup:
    return replace(setup, joint=Joint("flat", {}, setup.joint.seam_in_base_mm))


@st.composite
def setups(draw: st.DrawFn) -> Setup:
    """Joints of every type, stripes along rows and columns, 8 to 16 bits, small images."""
    name = draw(st.sampled_from(["flat", *DIMENSIONS]))
    width, height = draw(st.integers(MIN_PX, MAX_PX)), draw(st.integers(MIN_PX, MAX_PX))
    material = draw(st.sampled_from(MATERIALS))
    setup = nominal_setup("lap" if name == "flat" else name, material, width=width, height=height)
    setup = flat(setup) if name == "flat" else setup
    bits = draw(st.integers(8, 16))
    black_dn = draw(st.sampled_from([0.0, 4.0]))
    sensor = replace(setup.sensor, bits=bits, gain_e_per_dn=20400.0 / 2**bits, black_level_dn=black_dn)
    radiance_e = draw(st.sampled_from([1e-9, 1.0, 8.0e6]))
    setup = replace(
        setup,
        sensor=replace(sensor, gamma=draw(st.sampled_from([1.0, 0.45]))),
        arc=replace(setup.arc, radiance_e=radiance_e, on_surface=draw(st.booleans())),
        camera=replace(setup.camera, distortion=draw(st.sampled_from([(0.0,) * 5, (-0.1, 0.02, 0, 0, 0)]))),
    )
    if not draw(st.integers(0, 3)):
        setup = replace(setup, effects={draw(st.sampled_from(sorted(REGISTRY))): {}})
    return rolled(setup) if draw(st.booleans()) else setup


def image_dn(kind: str, shape: tuple[int, int], max_dn: int, rng: np.random.Generator) -> np.ndarray:
    """Return an image (H, W), float64, of codes up to `max_dn`."""
    height, width = shape
    level = rng.uniform(0.0, max_dn)
    if kind == "noise":
        return rng.normal(level, rng.uniform(0.5, 0.2 * max_dn), shape).clip(0.0, max_dn)
    if kind == "random":
        return rng.integers(0, max_dn + 1, shape).astype(float)
    if kind == "blocks":
        size = int(rng.integers(2, 17))
        blocks = rng.integers(0, max_dn + 1, (height // size + 1, width // size + 1))
        return np.kron(blocks, np.ones((size, size)))[:height, :width]
    if kind == "salt":
        return np.where(rng.random(shape) < 0.05, max_dn, 0.0)
    if kind in ("rows", "columns"):
        along, across = np.meshgrid(np.arange(width), np.arange(height))
        if kind == "columns":
            along, across = across, along
        image = rng.normal(0.1 * level, 0.02 * max_dn, shape)
        for _ in range(rng.integers(1, 4)):
            middle = rng.uniform(0.0, max(shape)) + rng.normal(0.0, 0.3) * along
            middle += rng.uniform(0.0, 6.0) * np.abs(along - rng.uniform(0.0, max(shape))) / 8.0
            image += level * np.exp(-0.5 * ((across - middle) / rng.uniform(0.5, 6.0)) ** 2)
        return image.clip(0.0, max_dn)
    image = np.full(shape, {"black": 0.0, "white": max_dn}.get(kind, level))
    if kind == "half":
        image[: height // 2] = max_dn
    return image


def seen_dn(setup: Setup, pose: Pose, rng: np.random.Generator) -> np.ndarray:
    """Return what the forward model draws (H, W), a part of it hidden by something else."""
    seam = SeamLine(0.0, *rng.normal(0.0, 0.5, 2))
    condition = Condition(rng.choice([0.1, 1.0, 10.0]), rng.choice([0.0, 1.0]), setup.camera.exposure_s)
    image = draw_frame(setup, pose.T_base_tool, condition, rng, seam=seam).astype(float)
    top, left = rng.integers(0, image.shape[0]), rng.integers(0, image.shape[1])
    hidden = image[top : top + rng.integers(1, MAX_PX), left : left + rng.integers(1, MAX_PX)]
    hidden[:] = image_dn(rng.choice(KINDS), hidden.shape, setup.sensor.max_dn, rng)
    return image


@st.composite
def frames(draw: st.DrawFn, setup: Setup, pose: Pose | None) -> Frame:
    """Frames of the right kind and of a wrong type or size, under any condition."""
    shape = (setup.camera.height, setup.camera.width)
    dtype: Any = setup.sensor.dtype
    max_dn = setup.sensor.max_dn
    if not draw(st.integers(0, 9)):
        dtype = draw(st.sampled_from([np.uint8, np.uint16, np.int16, np.float32, np.bool_, ">u2"]))
    if not draw(st.integers(0, 9)):
        shape = draw(st.tuples(st.integers(0, MAX_PX), st.integers(0, MAX_PX)))
    if dtype == np.uint16 and draw(st.booleans()):
        max_dn = 65535
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    kind = draw(st.sampled_from([*KINDS, *("seen",) * len(KINDS)]))
    if kind != "seen":
        image = image_dn(kind, shape, max_dn, rng).astype(dtype)
    elif is_near(pose):
        image = seen_dn(setup, pose, rng).astype(dtype)
    else:
        image = np.zeros(shape, dtype)
    if not draw(st.integers(0, 9)):
        image = image[..., None] if draw(st.booleans()) else image.ravel()
    return Frame(
        0,
        draw(st.one_of(st.floats(0.0, 10.0), odd_numbers)),
        image,
        draw(st.one_of(st.just(setup.camera.exposure_s), odd_numbers)),
        draw(st.one_of(st.just(100.0), odd_numbers)),
        draw(st.booleans()) or draw(st.booleans()),
        draw(st.booleans()),
    )


@st.composite
def poses(draw: st.DrawFn) -> Pose | None:
    """Poses near the joint, far, tilted, below the surface, none, and with numbers that are none."""
    if draw(st.booleans()):
        near = st.floats(-3.0, 3.0)
        turns = draw(near), draw(near), draw(near)
        return pose_at(draw(st.floats(0.0, 500.0)), draw(near), draw(near), turns)
    kind = draw(st.integers(0, 9))
    if kind == 0:
        return None
    shift = draw(shifts_mm), draw(shifts_mm), draw(shifts_mm)
    pose = pose_at(*shift, (draw(turns_deg), draw(turns_deg), draw(turns_deg)))
    if kind == 1:
        pose.T_base_tool[draw(st.integers(0, 3)), draw(st.integers(0, 3))] = draw(odd_numbers)
    return replace(pose, extrapolated=draw(st.booleans()))


def is_near(pose: Pose | None) -> TypeGuard[Pose]:
    """Say whether camera and laser surely stand above the joint."""
    return (
        pose is not None
        and bool((np.abs(pose.T_base_tool - np.eye(4))[:, 1:] <= 3.0).all())
        and bool(np.isfinite(pose.T_base_tool).all() and abs(np.trace(pose.T_base_tool) - 4.0) < 0.1)
    )


def assert_told(track: Track) -> None:
    """What is known is finite; a seam that is not has a flag that says why."""
    for f in fields(Track):
        value = getattr(track, f.name)
        if isinstance(value, float | tuple) and f.name not in ("timestamp_s", "valid_at_s", "checks"):
            numbers = np.hstack(value) if isinstance(value, tuple) else value
            assert not np.isinf(numbers).any(), (f.name, value)
    if not track.valid:
        assert track.flags & flags.INVALIDATING, track.flag_names
    else:
        assert np.isfinite(track.seam_tool_mm).all()
        assert track.sigma_y_mm > 0.0
        assert track.sigma_z_mm > 0.0
        assert 0.0 <= track.confidence <= 1.0
    failed = {check.flag.name for check in track.checks if not check.passed}
    assert failed == set(track.flag_names)
    if track.stripe is not None:
        found = np.isfinite(track.stripe.position_px)
        assert (track.stripe.sigma_px[found] > 0.0).all()


# A frame that is none of the camera's is warned of, and tracked over.
@pytest.mark.slow
@pytest.mark.filterwarnings(r"ignore:frame 0 (is|has|holds) :UserWarning")
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_no_frame_raises(data: st.DataObject) -> None:
    setup = data.draw(setups())
    tracker = Tracker(setup, use_arc_map=data.draw(st.booleans()))
    for _ in range(data.draw(st.integers(1, 5))):
        pose = data.draw(poses())
        assert_told(tracker.step(data.draw(frames(setup, pose)), pose))


def test_a_stripe_none_of_whose_lines_lies_on_a_plate_is_refused() -> None:
    """Random blocks in which lines are read, none of them where a plate of an edge joint would be."""
    setup = balance(nominal_setup("edge", "zn_coated", width=320, height=240))
    rng = np.random.default_rng(277)
    size = int(rng.integers(20, 33))
    blocks = rng.integers(0, 256, (240 // size + 1, 320 // size + 1))
    image = np.kron(blocks, np.ones((size, size)))[:240, :320].astype(np.uint8)
    track = Tracker(setup).step(Frame(0, 0.0, image, 0.005), Pose(np.eye(4)))
    assert not track.valid
    assert_told(track)
