"""Fit of the nuisances alone to a part of a recording, the other frames held out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from noise_model.compiled.arrays import Bool
from noise_model.setup import Setup
from sim_to_real.data.binned import ObservedRecording, PoseAt, observe
from sim_to_real.data.cross_validation import split_holdout
from sim_to_real.fit.gauss_newton import Refit, converge, refit
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.metal_of_stripe import metal_of_stripe
from sim_to_real.variance.random_effects import RandomEffects, random_effects
from tracker.state import Frame

OnStage = Callable[[str, float], None]
"""Callback with a diagnosis' activity, and the share of it that is done."""


@dataclass(frozen=True, eq=False)
class Baseline:
    """The fit of the nuisances alone: `fitted` at its `model`, with the random effects that it leaves.

    `held_out` are the frames that no fit sees. Their read noise is the one that the others show.
    """

    model: LinearizedModel
    fitted: Refit
    random: RandomEffects
    held_out: ObservedRecording


def silent(text: str, share: float) -> None:
    """Ignore a stage: the listener of nobody."""


def fit_baseline(
    setup: Setup,
    frames: Sequence[Frame],
    pose_at: PoseAt,
    threads: int,
    without: Sequence[str],
    tell: OnStage,
) -> Baseline:
    """Hold a quarter of a recording's frames out, and fit the nuisances to the others.

    A metal that the setup does not state is fitted to the stripe. Raises ValueError if no frame has a pose,
    if none can be held out, and if nothing can be compared.
    """
    tell("tracking the seam", 0.0)
    observed = observe(setup, frames, pose_at)
    holdout = split_holdout(observed, 0.25)
    train = _training_frames(observed, holdout)
    if "material" in setup.missing:
        tell("fitting the metal", 0.03)
        change = metal_of_stripe(train, threads)
        observed, train = observed.of_metal(change), train.of_metal(change)
    tell("fitting nuisances", 0.05)
    model, fitted, random = baseline_of(LinearizedModel(train, threads), without)
    # Pixels are weighed with the read noise that is seen; that of bins comes from the bins themselves.
    seen = observed.with_read_noise(random.read_ratio)
    return Baseline(model, fitted, random, seen.subset(holdout))


def baseline_of(
    model: LinearizedModel, without: Sequence[str]
) -> tuple[LinearizedModel, Refit, RandomEffects]:
    """Fit the nuisances alone, and return the model there; random effects are counted as noise."""
    model = model.anchored_at(model.neutral, {})
    fitted = refit(model, {}, model.neutral)
    model.mask_edges(fitted.nuisance, {})
    model.widen_noise_for_bends(fitted.nuisance, {})
    fitted = converge(model, fitted)
    random = random_effects(model, fitted, without)
    if random.effects:
        model.take_noise(random.sigmas_dn)
    model = model.anchored_at(fitted.nuisance, {})
    return model, refit(model, {}, fitted.nuisance), random


def _training_frames(observed: ObservedRecording, holdout: Bool) -> ObservedRecording:
    """Return the frames that are not held out (n_frames,); ValueError if they show nothing to compare."""
    if not holdout.any():
        raise ValueError(
            "no two frames have light, exposure and current alike, so none can be held out of the fit: "
            "record each kind twice or more"
        )
    train = observed.subset(~holdout)
    if not any(frame.keep.any() for frame in train.frames):
        raise ValueError(
            "nothing can be compared, all that shows of the joint is saturated: shorten the exposure"
        )
    if train.lit.any() and not train.shows_arc.any():
        raise ValueError(
            "nothing that the arc lights can be compared, all of it is saturated: shorten the exposure, "
            "or leave the frames with the arc out"
        )
    return train
