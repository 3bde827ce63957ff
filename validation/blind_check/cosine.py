"""The trivial baseline of the blind check: which effect's signature does the raw residual look like most.

Nothing is fitted. The residual is what was recorded less what the nominal setup predicts, an effect's
signature what the prediction changes by with the effect's typical values, both in DN over all bins that
count.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.effects import REGISTRY, Effects
from noise_model.setup import Setup
from sim_to_real.data.binned import ObservedRecording, PoseAt, observe
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.search.score_test import EXPENSIVE
from tracker.state import Frame

FRAME_STEP = 6
"""Effects that are dear are compared on every so many frames only."""


def cosines(setup: Setup, frames: Sequence[Frame], pose_at: PoseAt) -> dict[str, float]:
    """Return the cosine between a recording's residual and each effect's signature, by the effect's id.

    NaN for an effect that does not change what a frame is on average, and where nothing is left to explain.
    Raises ValueError if no frame has a pose.
    """
    observed = observe(setup, frames, pose_at)
    sampled = observed.subset(np.arange(len(observed.frames)) % FRAME_STEP == 0)
    return cosines_of(observed, [name for name in REGISTRY if name not in EXPENSIVE]) | cosines_of(
        sampled, EXPENSIVE
    )


def cosines_of(observed: ObservedRecording, ids: Iterable[str]) -> dict[str, float]:
    """Return the cosine between frames' residual and the signature of some effects, by id, see `cosines`."""
    model = LinearizedModel(observed)
    recorded_dn = np.concatenate([frame.kept_dn for frame in observed.frames])
    nominal_dn = _predicted_dn(model, {})
    cosine_of = {}
    for name in ids:
        signature_dn = _predicted_dn(model, {name: REGISTRY[name].complete(REGISTRY[name].typical)})
        cosine_of[name] = cosine(recorded_dn - nominal_dn, signature_dn - nominal_dn)
    return cosine_of


def cosine(a: Float64, b: Float64) -> float:
    """Return the cosine of the angle between vectors (n,); NaN if one of them is nought."""
    sizes = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / sizes if sizes > 0.0 else np.nan


def _predicted_dn(model: LinearizedModel, effects: Effects) -> Float64:
    """Return the mean DN (n,) of all bins that count, frame after frame."""
    return np.concatenate([light.mean_dn() for light in model.lights(model.neutral, effects)])
