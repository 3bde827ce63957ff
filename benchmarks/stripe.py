"""The stripe's centre against its Cramer-Rao bound, ours beside Steger, sato and a grey centroid.

    python benchmarks/stripe.py [--draws N] [--speckle CONTRAST]

Frames of a V-groove are predicted for a grid of stripe level, arc level and stripe width, and drawn with
noise. Columns on smooth faces and columns beside corners are told apart. The truth is where the laser plane's
trace falls, and by how much the light's change across the stripe moves a symmetric fit. Ours is judged column
by column and with its neighbours along the stripe. With --speckle the frames have laser speckle.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from dataclasses import dataclass, replace

import numpy as np

from arctrack.nominal import nominal_setup
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.condition import Condition
from noise_model.forward import Renderer, draw_frame, predict
from noise_model.plan.cramer_rao import POSITION, stripe_sigmas
from noise_model.setup import Setup
from tracker.geometry import SensorGeometry
from tracker.state import Frame, Pose, Stripe
from tracker.stripe.expected import ExpectedStripe, expect_stripe
from tracker.stripe.smooth import smoothed
from tracker.tracker import Tracker
from validation.bench.stripe_peers import PEERS

STRIPES_E, ARCS, WIDTHS_PX = (500.0, 1500.0, 4500.0), (0.0, 1.0, 3.0), (3.5, 7.0)
"""The stripe's peak on the plate, the arc's light there over it, the stripe's sigma."""

SEEN_PX = 0.5
"""A column whose bound is larger shows no stripe worth reading."""

GROSS_PX = 2.0

CORNER_COLUMNS = 5
"""A column this near to a corner is beside it."""

HALF_WINDOW_SIGMAS = 4.0
"""The bound counts pixels this near: beyond them a column says nothing of its stripe."""


@dataclass(frozen=True)
class Case:
    """A predicted frame and what is true of its columns (n,): centre, bound, on a face, beside a corner."""

    setup: Setup
    center_px: Float64
    bound_px: Float64
    on_face: np.ndarray
    at_corner: np.ndarray


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
    center = expected.position_px + expected.bias_px
    reach = math.ceil(HALF_WINDOW_SIGMAS * width_px)
    window = rows[:, None] + np.arange(-reach, reach + 1)[None, :]
    variance = (prediction.variance_dn2 * setup.sensor.gain_e_per_dn**2)[window, columns[:, None]]
    amplitude = laser[rows, columns].astype(np.float64)
    sigmas = stripe_sigmas(window - center[:, None], amplitude, expected.sigma_px, variance)
    # A face is smooth where the trace runs straight for four of the stripe's sigmas to either side.
    bend = np.abs(np.gradient(np.gradient(expected.position_px)))
    near, beside = (
        np.convolve(bend > 0.05, np.ones(2 * reach + 1), "same") > 0.0
        for reach in (math.ceil(4.0 * width_px), CORNER_COLUMNS)
    )
    return Case(setup, center, sigmas[:, POSITION], ~near, beside)


def expected_of(setup: Setup) -> ExpectedStripe:
    expected = expect_stripe(SensorGeometry.of(setup), make_scene(setup, np.eye(4)))
    assert expected is not None
    return expected


def width_px_of(setup: Setup, sheet_mm: float) -> float:
    """Return the 1 sigma of a sheet on the plate, px, without the lens' point-spread function."""
    thin = replace(setup, laser=replace(setup.laser, stripe_sigma_mm=sheet_mm))
    return math.sqrt(float(np.median(expected_of(thin).sigma_px)) ** 2 - setup.camera.psf_sigma_px**2)


def frames_of(case: Case, draws: int, arc: float) -> list[Frame]:
    """Draw frames of a case, its setup's speckle and noise in them."""
    rng, renderer = np.random.default_rng(0), Renderer()
    condition = Condition(1.0, 1.0 if arc else 0.0, 0.005)
    return [
        Frame(
            n,
            0.1 * n,
            draw_frame(case.setup, np.eye(4), condition, rng, renderer=renderer),
            0.005,
            100.0,
            arc_on=arc > 0.0,
        )
        for n in range(draws)
    ]


def ours(case: Case, frames: list[Frame]) -> tuple[list[Stripe], float]:
    """Return the tracker's stripes in track mode, and ms a frame."""
    tracker, pose = Tracker(case.setup), Pose(np.eye(4))
    for frame in frames[:3]:
        tracker.step(frame, pose)
    started = time.perf_counter()
    stripes = [stripe for frame in frames if (stripe := tracker.step(frame, pose).stripe)]
    took_ms = 1e3 * (time.perf_counter() - started) / len(frames)
    assert len(stripes) == len(frames)
    return stripes, took_ms


def scores(case: Case, position_px: Float64) -> list[float]:
    """Return error and bias over the bound on faces and beside corners; gross errors and read columns, %."""
    error = position_px - case.center_px
    seen = case.bound_px < SEEN_PX
    ratio = error / case.bound_px
    of_faces, of_corners = ratio[:, seen & case.on_face], ratio[:, seen & case.at_corner]
    of_corners = of_corners[:, np.isfinite(of_corners).any(axis=0)]
    gross = np.abs(error[:, seen]) > GROSS_PX
    return [
        1.4826 * float(np.nanmedian(np.abs(of_faces))),
        float(np.nanmedian(of_faces)),
        1.4826 * float(np.nanmedian(np.abs(of_corners))),
        float(np.nanmedian(np.abs(np.nanmean(of_corners, axis=0)))),
        100.0 * float(gross.mean()),
        100.0 * float(np.isfinite(error[:, seen]).mean()),
    ]


def chi2(case: Case, position_px: Float64, sigma_px: Float64) -> list[float]:
    """Return the mean square of errors over stated sigmas on faces and beside corners."""
    square = ((position_px - case.center_px) / sigma_px) ** 2
    seen = case.bound_px < SEEN_PX
    # An unflagged gross error counts as such and would hide all else.
    square[np.abs(position_px - case.center_px) > GROSS_PX] = np.nan
    return [float(np.nanmean(square[:, seen & where])) for where in (case.on_face, case.at_corner)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=6)
    parser.add_argument("--speckle", type=float, default=0.0, metavar="CONTRAST")
    options = parser.parse_args()
    print(
        "error: 1.4826 median |error| over the Cramer-Rao bound and its bias, on faces; corners: error within"
    )
    print(f"{CORNER_COLUMNS} columns of a corner, and the median |mean error| there; gross: unflagged, more")
    print(f"than {GROSS_PX:.0f} px off; chi2: mean, of stated sigmas, on faces and at corners")
    print(
        f"{'stripe, e-':>10} {'arc':>4} {'px':>4} {'bound':>6}  {'method':10} {'error':>7} {'bias':>6}"
        f" {'corners':>7} {'bias':>6} {'gross %':>7} {'read %':>6} {'chi2':>5} {'':>5} {'ms':>6}"
    )
    for stripe_e, arc, width in itertools.product(STRIPES_E, ARCS, WIDTHS_PX):
        case = case_of(stripe_e, arc, width)
        if options.speckle:
            effects = {"laser_speckle": {"contrast": options.speckle}}
            case = replace(case, setup=replace(case.setup, effects=effects))
        print_case(case, frames_of(case, options.draws, arc), (stripe_e, arc, width))


def print_case(case: Case, frames: list[Frame], of: tuple[float, float, float]) -> None:
    """Print one row for each method."""
    stripes, took_ms = ours(case, frames)
    own, sigma = (
        np.array([getattr(stripe, name) for stripe in stripes]) for name in ("position_px", "sigma_px")
    )
    smooth, smooth_sigma = np.array([smoothed(stripe) for stripe in stripes]).swapaxes(0, 1)
    rows = {
        "arctrack": (own, chi2(case, own, sigma), took_ms),
        "neighbours": (smooth, chi2(case, smooth, smooth_sigma), took_ms),
    }
    for name, peer in PEERS.items():
        started = time.perf_counter()
        found = np.array([peer(frame.image_dn, of[2]) for frame in frames])
        rows[name] = found, [], 1e3 * (time.perf_counter() - started) / len(frames)
    bound = float(np.median(case.bound_px[case.on_face]))
    for name, (position_px, of_sigma, ms) in rows.items():
        error, bias, corner_error, corner_bias, gross, read = scores(case, position_px)
        print(
            f"{of[0]:10.0f} {of[1]:4.0f} {of[2]:4.1f} {bound:6.3f}  {name:10} {error:7.2f} {bias:6.2f}"
            f" {corner_error:7.2f} {corner_bias:6.2f} {gross:7.2f} {read:6.1f}"
            f" {' '.join(f'{value:5.2f}' for value in of_sigma) or 11 * ' '} {ms:6.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
