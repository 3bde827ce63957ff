"""The stripe's centre against its Cramer-Rao bound, ours beside Steger, sato and a grey centroid.

    python benchmarks/stripe.py [--draws N]

Frames of a V-groove are predicted for a grid of stripe level, arc level and stripe width, and drawn with
noise. Columns on smooth faces and columns beside corners are told apart. The truth is where the laser plane's
trace falls, and by how much the light's change across the stripe moves a symmetric fit.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from dataclasses import dataclass, replace

import numpy as np
from stripe_peers import PEERS

from arctrack.nominal import nominal_setup
from noise_model.arc_map import scene
from noise_model.bound import POSITION, stripe_sigmas
from noise_model.condition import Condition
from noise_model.forward import Prediction, predict
from noise_model.frames import Float64
from noise_model.sensor import expose
from noise_model.setup import Setup
from tracker.expected import ExpectedStripe, expect_stripe
from tracker.geometry import SensorGeometry
from tracker.state import Frame, Pose
from tracker.step import Tracker

STRIPES_E, ARCS, WIDTHS_PX = (500.0, 1500.0, 4500.0), (0.0, 1.0, 3.0), (3.5, 7.0)
"""The stripe's peak on the plate, the arc's light there over it, the stripe's sigma."""

SEEN_PX = 0.5
"""A column whose bound is larger shows no stripe worth reading."""

GROSS_PX = 2.0

HALF_WINDOW_SIGMAS = 4.0
"""The bound counts pixels this near: beyond them a column says nothing of its stripe."""


@dataclass(frozen=True)
class Case:
    """A predicted frame and what is true of its columns (n,): centre, bound and whether it is on a face."""

    setup: Setup
    prediction: Prediction
    center_px: Float64
    bound_px: Float64
    on_face: np.ndarray


def case_of(stripe_e: float, arc: float, width_px: float) -> Case:
    """Return a level pose over a V-groove whose plate shows a stripe and arc light so bright."""
    setup = nominal_setup("v_groove", "mild_steel")
    per_mm = width_px_of(setup, 1.0)
    sheet = math.sqrt(width_px**2 - setup.camera.psf_sigma_px**2) / per_mm
    setup = replace(setup, laser=replace(setup.laser, stripe_sigma_mm=sheet, peak_e=stripe_e))
    T_base_tool, expected = np.eye(4), expected_of(setup)
    rows = np.rint(expected.position_px).astype(int)
    columns = np.arange(len(rows))
    unit = predict(setup, T_base_tool, Condition(0.0, 1.0, 0.005)).mean_e
    radiance = arc * stripe_e / float(np.median(unit[rows, columns]))
    setup = replace(setup, arc=replace(setup.arc, radiance_e=radiance)) if arc else setup
    prediction = predict(setup, T_base_tool, Condition(1.0, 1.0 if arc else 0.0, 0.005))
    laser = predict(setup, T_base_tool, Condition(1.0, 0.0, 0.005)).mean_e
    center = expected.position_px + expected.lean_px
    reach = math.ceil(HALF_WINDOW_SIGMAS * width_px)
    window = rows[:, None] + np.arange(-reach, reach + 1)[None, :]
    variance = (prediction.variance_dn2 * setup.sensor.gain_e_per_dn**2)[window, columns[:, None]]
    amplitude = laser[rows, columns].astype(np.float64)
    sigmas = stripe_sigmas(window - center[:, None], amplitude, expected.sigma_px, variance)
    # A face is smooth where the trace runs straight for four of the stripe's sigmas to either side.
    bend = np.abs(np.gradient(np.gradient(expected.position_px)))
    corner = np.convolve(bend > 0.05, np.ones(2 * math.ceil(4.0 * width_px) + 1), "same") > 0.0
    return Case(setup, prediction, center, sigmas[:, POSITION], ~corner)


def expected_of(setup: Setup) -> ExpectedStripe:
    expected = expect_stripe(SensorGeometry.of(setup), scene(setup, np.eye(4)))
    assert expected is not None
    return expected


def width_px_of(setup: Setup, sheet_mm: float) -> float:
    """Return the 1 sigma of a sheet on the plate, px, without the lens' point-spread function."""
    thin = replace(setup, laser=replace(setup.laser, stripe_sigma_mm=sheet_mm))
    return math.sqrt(float(np.median(expected_of(thin).sigma_px)) ** 2 - setup.camera.psf_sigma_px**2)


def frames_of(case: Case, draws: int, arc: float) -> list[Frame]:
    rng = np.random.default_rng(0)
    mean_e = case.prediction.mean_e.astype(np.float64)
    return [
        Frame(n, 0.1 * n, expose(mean_e, case.setup.sensor, rng), 0.005, 100.0, arc_on=arc > 0.0)
        for n in range(draws)
    ]


def ours(case: Case, frames: list[Frame]) -> tuple[Float64, Float64, float]:
    """Return centres and stated sigmas (frames, columns) of the tracker in track mode, and ms a frame."""
    tracker, pose = Tracker(case.setup), Pose(np.eye(4))
    for frame in frames[:3]:
        tracker.step(frame, pose)
    started = time.perf_counter()
    stripes = [stripe for frame in frames if (stripe := tracker.step(frame, pose).stripe)]
    took_ms = 1e3 * (time.perf_counter() - started) / len(frames)
    assert len(stripes) == len(frames)
    return (
        np.array([stripe.position_px for stripe in stripes]),
        np.array([stripe.sigma_px for stripe in stripes]),
        took_ms,
    )


def scores(case: Case, position_px: Float64) -> list[float]:
    """Return the error over the bound and its bias on faces and at corners, gross errors and read columns."""
    error = position_px - case.center_px
    seen = case.bound_px < SEEN_PX
    ratio = error / case.bound_px
    of_faces, of_corners = ratio[:, seen & case.on_face], ratio[:, seen & ~case.on_face]
    of_corners = of_corners[:, np.isfinite(of_corners).any(axis=0)]
    gross = np.abs(error[:, seen]) > GROSS_PX
    return [
        1.4826 * float(np.nanmedian(np.abs(of_faces))),
        float(np.nanmedian(of_faces)),
        float(np.nanmedian(np.abs(np.nanmean(of_corners, axis=0)))),
        100.0 * float(gross.mean()),
        100.0 * float(np.isfinite(error[:, seen]).mean()),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=6)
    draws = parser.parse_args().draws
    print("error: 1.4826 median |error| on faces over the Cramer-Rao bound; bias: its median; corners: the")
    print(
        "median |mean error| beside corners over the bound; gross: more than 2 px off; chi2: of stated sigmas"
    )
    print(
        f"{'stripe, e-':>10} {'arc':>4} {'px':>4} {'bound':>6}  {'method':9} {'error':>6} {'bias':>6}"
        f" {'corners':>7} {'gross %':>7} {'read %':>6} {'chi2':>5} {'ms':>6}"
    )
    for stripe_e, arc, width in itertools.product(STRIPES_E, ARCS, WIDTHS_PX):
        case = case_of(stripe_e, arc, width)
        frames = frames_of(case, draws, arc)
        position, sigma, took_ms = ours(case, frames)
        took, found = {"arctrack": took_ms}, {"arctrack": position}
        for name, peer in PEERS.items():
            started = time.perf_counter()
            found[name] = np.array([peer(frame.image_dn, width) for frame in frames])
            took[name] = 1e3 * (time.perf_counter() - started) / len(frames)
        seen = (case.bound_px < SEEN_PX) & case.on_face
        pull = ((position - case.center_px) / sigma)[:, seen]
        chi2 = {"arctrack": f"{1.4826**2 * float(np.nanmedian(pull**2)):.2f}"}
        bound = float(np.median(case.bound_px[case.on_face]))
        for name, position_px in found.items():
            error, bias, corners, gross, read = scores(case, position_px)
            print(
                f"{stripe_e:10.0f} {arc:4.0f} {width:4.1f} {bound:6.3f}  {name:9} {error:6.2f} {bias:6.2f}"
                f" {corners:7.2f} {gross:7.2f} {read:6.1f} {chi2.get(name, ''):>5} {took[name]:6.1f}"
            )


if __name__ == "__main__":
    main()
