"""What a recording can tell apart at all, and the smallest magnitude of each effect that would show.

An effect's signature is its change of the residuals, with all that nuisances can do projected out. Two
effects are indistinguishable if their signatures lie within each other's span. The smallest magnitude that
shows is the one whose signature outweighs the penalty of the effect's parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from noise_model.arrays import Float64
from noise_model.effects import REGISTRY
from sim_to_real.diagnosis import Estimate
from sim_to_real.fit.gauss_newton import MIN_EVIDENCE_NATS, Refit
from sim_to_real.fit.quadratic import N_EFFECTIVE
from sim_to_real.search.hypothesis import bic_penalty_nats
from sim_to_real.search.score_test import ScoreTest

INDISTINGUISHABLE_COSINE = 0.98
"""Two effects are indistinguishable if the cosine between their signatures' spans is larger."""


def projected_signatures(baseline: Refit, scores: Sequence[ScoreTest]) -> dict[str, Float64]:
    """Return effects' signatures (n, k): what their probe points change in residuals and, below, in priors.

    What nuisances can do within their priors is projected out. The priors' weight is that of residuals as
    large as the model's floor, see `Quadratic.prior_weight`.
    """
    weight = max(len(baseline.jacobian) / N_EFFECTIVE, 1.0)
    sigmas = np.array([parameter.prior_sigma for parameter in baseline.quadratic.parameters])
    priors = math.sqrt(weight) / sigmas
    basis, _ = np.linalg.qr(np.vstack([baseline.jacobian, np.diag(priors)]))
    signatures = {}
    for score in scores:
        signature = np.vstack([score.signature, np.zeros((len(priors), score.signature.shape[1]))])
        signatures[score.id] = signature - basis @ (basis.T @ signature)
    return signatures


def not_resolvable(signatures: Mapping[str, Float64]) -> tuple[tuple[str, str], ...]:
    """Return the pairs of effects that this recording cannot tell apart."""
    names = [name for name, signature in signatures.items() if np.linalg.norm(signature) > 0.0]
    spans = {name: _span(signatures[name]) for name in names}
    pairs = []
    for n, name in enumerate(names):
        for other in names[n + 1 :]:
            small, large = sorted((spans[name], spans[other]), key=lambda span: span.shape[1])
            # All of the smaller span must lie within the larger: the smallest cosine counts.
            cosines = np.linalg.svd(large.T @ small, compute_uv=False)
            if small.shape[1] and cosines.min() > INDISTINGUISHABLE_COSINE:
                pairs.append((name, other))
    return tuple(pairs)


def _span(signature: Float64) -> Float64:
    """Return an orthonormal basis (n, k) of a signature's columns that are not zero."""
    sizes = np.linalg.norm(signature, axis=0)
    basis, weight, _ = np.linalg.svd(signature / np.maximum(sizes, 1e-12), full_matrices=False)
    return np.asarray(basis[:, weight > 1e-3])


def smallest_detectable(
    signatures: Mapping[str, Float64], scores: Sequence[ScoreTest]
) -> dict[str, Estimate]:
    """Return the smallest magnitude of each effect that would show; effects that never show are left out."""
    magnitudes = {}
    for score in scores:
        n = len(score.signature)
        per_unit = float(np.sum(signatures[score.id][:, 0] ** 2)) / n
        evidence = MIN_EVIDENCE_NATS + bic_penalty_nats(len(REGISTRY[score.id].parameters))
        needed = math.expm1(2.0 * evidence / N_EFFECTIVE)
        # Where light ends is a place, and has no magnitude.
        if per_unit > 0.0 and score.steps[0].any():
            moved = int(np.flatnonzero(score.steps[0])[0])
            step, unit = float(score.steps[0, moved]), REGISTRY[score.id].parameters[moved].unit
            magnitudes[score.id] = Estimate(abs(step) * math.sqrt(needed / per_unit), math.nan, unit)
    return magnitudes
