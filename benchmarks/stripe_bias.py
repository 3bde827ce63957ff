"""The stripe's bias against where in its pixel the centre truly lies.

    python benchmarks/stripe_bias.py PICTURE [--draws N]

The tool is lifted over a V-groove in steps that add up to a pixel of the stripe's centre. Each step is drawn
with noise, and the errors of all unflagged columns on smooth faces are averaged by the true centre's place
within its pixel, read column by column and with neighbours. The band is twice the mean's 1 sigma.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from stripe import Case, case_of, expected_of

from arctrack.report import style
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.condition import Condition
from noise_model.forward import Renderer, draw_frame
from tracker.geometry import SensorGeometry
from tracker.state import Frame, Pose
from tracker.stripe.expected import expect_stripe
from tracker.stripe.smooth import smoothed
from tracker.tracker import Tracker

WIDTHS_PX, STRIPE_E, ARC = (2.0, 3.5, 7.0), 4500.0, 1.0
STEPS, BINS = 20, 20
COLOURS = (style.ORANGE, style.BLUE, style.GREEN)


@dataclass(frozen=True)
class Bias:
    """Mean error and its 1 sigma (BINS,), px, by the true centre's place within its pixel."""

    mean_px: Float64
    sigma_px: Float64


def step_poses(case: Case) -> list[Float64]:
    """Return poses whose stripes lie evenly over one pixel."""
    lifted = np.eye(4)
    lifted[2, 3] = 0.1
    geometry = SensorGeometry.of(case.setup)
    there = expect_stripe(geometry, make_scene(case.setup, lifted))
    assert there is not None
    per_mm = float(np.median(there.position_px - expected_of(case.setup).position_px)) / 0.1
    poses = [np.eye(4) for _ in range(STEPS)]
    for n, pose in enumerate(poses):
        pose[2, 3] = (n + 0.5) / STEPS / per_mm
    return poses


def biases(case: Case, draws: int) -> tuple[Bias, Bias]:
    """Return the bias of columns read alone and with neighbours."""
    geometry, rng = SensorGeometry.of(case.setup), np.random.default_rng(0)
    places, errors = [], []
    for n, pose in enumerate(step_poses(case)):
        expected = expect_stripe(geometry, make_scene(case.setup, pose))
        assert expected is not None
        true = expected.position_px + expected.bias_px
        place = np.minimum((np.mod(true, 1.0) * BINS).astype(int), BINS - 1)
        tracker, renderer = Tracker(case.setup), Renderer()
        for draw in range(draws):
            image = draw_frame(case.setup, pose, Condition(1.0, 1.0, 0.005), rng, renderer=renderer)
            stripe = tracker.step(Frame(draw, 0.1 * draw, image, 0.005, 100.0), Pose(pose)).stripe
            assert stripe is not None, n
            smooth_px = smoothed(stripe).position_px
            read = case.on_face & np.isfinite(smooth_px)
            places.append(place[read])
            errors.append(np.stack([stripe.position_px, smooth_px])[:, read] - true[read])
    place, error = np.concatenate(places), np.concatenate(errors, axis=1)
    count = np.bincount(place, minlength=BINS)
    own, neighbours = (np.bincount(place, one, BINS) / count for one in error)
    # Neighbours share their draws: a sum of what they agree on scatters as the sum of their own centres does.
    sigma = np.sqrt(np.bincount(place, error[0] ** 2, BINS) / count - own**2) / np.sqrt(count)
    return Bias(own, sigma), Bias(neighbours, sigma)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("picture")
    parser.add_argument("--draws", type=int, default=3)
    options = parser.parse_args()
    title = f"Bias of the stripe's centre: {STRIPE_E:.0f} e⁻ in as much arc light"
    figure = style.new_figure(9.0, 4.2, title)
    panels = figure.subplots(1, 2, sharey=True)
    at = (np.arange(BINS) + 0.5) / BINS
    for width, colour in zip(WIDTHS_PX, COLOURS, strict=True):
        case = case_of(STRIPE_E, ARC, width)
        bound = float(np.median(case.bound_px[case.on_face]))
        for axes, bias, name in zip(panels, biases(case, options.draws), ("own", "neighbours"), strict=True):
            low, high = bias.mean_px - 2.0 * bias.sigma_px, bias.mean_px + 2.0 * bias.sigma_px
            axes.fill_between(at, low, high, color=colour, alpha=0.2, linewidth=0)
            label = f"σ {width:g} px, bound {bound:.3f} px"
            axes.plot(at, bias.mean_px, color=colour, marker="o", markersize=3, label=label)
            largest, sigma = np.abs(bias.mean_px).max(), np.median(bias.sigma_px)
            print(
                f"width {width:3.1f} px, bound {bound:.4f} px, {name:10}: mean {bias.mean_px.mean():+.4f} px,"
                f" largest of {BINS} places {largest:.4f}, 1 sigma of one {sigma:.4f}"
            )
    for axes, name in zip(panels, ("each column alone", "with its neighbours"), strict=True):
        style.plain(axes, "true centre's place within its pixel [px]", "mean error [px]", name)
        axes.axhline(0.0, color=style.BLACK, linewidth=0.8)
    panels[1].set_ylabel("")
    panels[0].margins(y=0.2)
    panels[0].legend(frameon=False, loc="upper left", fontsize=8, ncols=2)
    figure.savefig(options.picture)


if __name__ == "__main__":
    main()
