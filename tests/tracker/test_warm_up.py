"""After a warm-up no frame waits: no kernel is compiled, nor loaded from disk, whatever a frame shows.

Each joint has a process of its own, forked before any kernel was used. In it every function that numba
compiles, or finds on disk, counts: on an empty cache each of them would be compiled. None is compiled for a
constant that another passes to it.
"""

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rendered import EXPOSURE_S, frame_of, pose_at, small_setup

from arctrack.nominal import DIMENSIONS, nominal_setup
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from tracker.geometry import SensorGeometry
from tracker.state import Frame, Pose
from tracker.stripe.read import Work
from tracker.tracker import Tracker

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]

LIGHTS = [(1.0, 1.0)] * 4 + [(1.0, 0.0), (0.0, 1.0), (0.0, 0.0), (5.0, 1.0)]
"""Levels of laser and arc, frame by frame."""

TRACK = """
import gc, os, pickle, sys
from numba.core.dispatcher import Dispatcher
from tracker.tracker import Tracker

def used():
    return {
        f"{d.py_func.__module__}.{d.py_func.__qualname__}{signature}"
        for d in gc.get_objects() if isinstance(d, Dispatcher)
        for signature in (*d.stats.cache_hits, *d.stats.cache_misses)
    }

def track(warm, setup, frames):
    Tracker(warm).warm_up()
    tracker, ready = Tracker(setup), used()
    state = tracker.state
    valid = sum(tracker.step(frame, pose).valid for frame, pose in frames)
    # Where nothing is on disk yet, numba compiles functions of its own for constants.
    for_constants = [name for name in ready if "Literal" in name and not name.startswith("numba.")]
    return state.frames, valid, len(ready), used() - ready, for_constants

try:
    while True:
        given = pickle.load(sys.stdin.buffer)
        if os.fork() == 0:
            pickle.dump(track(*given), sys.stdout.buffer)
            sys.stdout.flush()
            os._exit(0)
        if os.wait()[1] != 0:
            sys.exit(1)
except EOFError:
    pass
"""


@pytest.fixture(scope="module")
def imported() -> Iterator[subprocess.Popen[bytes]]:
    """Return a process that has imported the tracker and no more; it forks one for each joint."""
    with subprocess.Popen(
        [sys.executable, "-c", TRACK],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    ) as process:
        yield process
        assert process.stdin is not None
        process.stdin.close()
    assert process.returncode == 0


def recorded(joint: str, width: int) -> tuple[Setup, list[tuple[Frame, Pose | None]]]:
    """Return a setup and frames of many kinds, by the forward model: none as the warm-up makes them up."""
    setup, frames = small_setup(joint, width=width), []
    rng = np.random.default_rng(7)
    for index, x_mm in enumerate(np.arange(0.0, 12.0, 1.0)):
        seam = SeamLine(y_mm=0.4 + 0.02 * x_mm, z_mm=-0.2)
        pose = pose_at(float(x_mm), *rng.normal(0.0, 0.2, 2), tuple(rng.normal(0.0, 0.5, 3)))
        laser, arc = LIGHTS[index % len(LIGHTS)]
        frames.append((frame_of(setup, pose, seam, laser=laser, arc=arc, index=index), pose))
    frame, pose = frames[0]
    image = frame.image_dn
    ghost = np.maximum(image, np.roll(image, 14 * width // 320, axis=0) // 2)
    noise = rng.integers(0, 60, image.shape, dtype=image.dtype)
    halved = image.copy()
    halved[:, : image.shape[1] // 2] = noise[:, : image.shape[1] // 2]
    read_only = image.copy()
    read_only.flags.writeable = False
    aside = np.roll(image, 25 * width // 320, axis=0)
    streaked = image.copy()
    streaked[::9] = 255
    pictures = [ghost, noise, halved, read_only, np.asfortranarray(image), image[:, ::-1], streaked]
    pictures += [np.zeros_like(image), np.full_like(image, 255), image.T, *[aside] * 6, *[noise] * 5, image]
    frames += [(replace(frame, index=50 + n, image_dn=p), pose) for n, p in enumerate(pictures)]
    single = Pose(np.asfortranarray(pose.T_base_tool.astype(np.float32)), extrapolated=True)
    blind = [pose_at(0.0, 0.0, z_mm) for z_mm in (400.0, -400.0)]
    frames += [(replace(frame, index=80 + n), other) for n, other in enumerate([single, *blind, None])]
    frames.append((replace(frame, index=90, exposure_s=float("nan"), current_a=float("nan")), pose))
    frames.append((replace(frame, index=91, exposure_s=2.0 * EXPOSURE_S, current_a=150.0), pose_at(5000.0)))
    return setup, frames


def turning(setup: Setup) -> Setup:
    """A setup whose nominal seam turns to the left, by a radius of 500 mm."""
    points = tuple((float(x), float(x * x / 1000.0), 0.0) for x in np.arange(0.0, 200.0, 5.0))
    return replace(setup, joint=replace(setup.joint, seam_in_base_mm=points))


# The warm-up makes up its images with 240 rows: of the larger ones with larger pixels. That of a straight
# seam is one of those that turn, too: arctrack comes with no other kernels for them.
@pytest.mark.parametrize(
    ("joint", "width", "turns"),
    [
        *((joint, 320, False) for joint in DIMENSIONS),
        *((joint, 640, False) for joint in ("v_groove", "corrugation")),
        *((joint, 320, True) for joint in ("lap", "fillet")),
    ],
)
def test_no_frame_waits_after_the_warm_up(
    joint: str, width: int, turns: bool, imported: subprocess.Popen[bytes], compiled: None
) -> None:
    assert imported.stdin is not None
    assert imported.stdout is not None
    setup, frames = recorded(joint, width)
    pickle.dump((setup, turning(setup) if turns else setup, frames), imported.stdin)
    imported.stdin.flush()
    frames_before, valid, ready, waited, for_constants = pickle.load(imported.stdout)
    assert frames_before == 0
    assert valid > 0
    assert ready > 15
    assert sorted(waited) == []
    assert for_constants == []


def test_what_is_warm_takes_no_path_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tracker.warm_up._warm", set())
    setup = small_setup("v_groove")
    Tracker(setup).warm_up()

    def called(*_: object) -> None:
        raise AssertionError("a step was taken")

    monkeypatch.setattr("tracker.warm_up.step", called)
    nearer = replace(setup, camera=replace(setup.camera, fx=0.9 * setup.camera.fx))
    assert Tracker(nearer).warm_up().compiled == 0
    for other in (small_setup("lap"), small_setup("v_groove", upright=True)):
        with pytest.raises(AssertionError, match="a step was taken"):
            Tracker(other).warm_up()


@pytest.mark.parametrize("joint", ["v_groove", "corrugation"])
def test_no_frame_waits_for_a_setups_tables(joint: str) -> None:
    """Of a second setup of the same kind no path is taken, but its tables are its own."""
    setup = small_setup(joint)
    Tracker(setup).warm_up()
    nearer = Tracker(replace(setup, camera=replace(setup.camera, fx=0.9 * setup.camera.fx)))
    nearer.warm_up()
    before = set(vars(nearer.geometry))
    assert "baked_light" in before
    frame, pose = recorded(joint, 320)[1][0]
    nearer.step(frame, pose)
    assert set(vars(nearer.geometry)) == before


@pytest.mark.skipif(sys.platform != "linux", reason="other systems count faults otherwise")
def test_no_frame_waits_for_memory_that_was_never_written_to() -> None:
    """A page is given when it is first written to: 7000 of them for a megapixel, or 14 large ones."""
    import resource

    geometry = SensorGeometry.of(nominal_setup("v_groove", "mild_steel", width=1280, height=1024))
    pixels = Work.of(geometry).pixels
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for array in pixels:
        array.fill(1)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before < 7
