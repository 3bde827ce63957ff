"""What a recording can tell apart at all, and the smallest magnitude of each effect that would show.

An effect's signature is what it does to the residuals, with all that nuisances can do projected out. Two
effects whose signatures lie within each other's span look the same; the smallest magnitude that shows is
where the signature outweighs what the effect's parameters cost.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from noise_model.arrays import Float64
from noise_model.effects import REGISTRY
from sim_to_real.diagnosis import Estimate
from sim_to_real.fit.gauss_newton import NAMED_FROM, Refit
from sim_to_real.fit.quadratic import N_EFFECTIVE
from sim_to_real.search.hypothesis import cost_nats
from sim_to_real.search.score_test import Screened

ALIKE = 0.98
"""A signature of which this share, as a cosine, lies in another's span cannot be told from it."""


def own_signatures(baseline: Refit, screened: Sequence[Screened]) -> dict[str, Float64]:
    """Return effects' signatures (n, k): what their places do to residuals and, below, to priors' pulls.

    What nuisances can do is projected out, within what priors let them if as much is left as the model may
    be off, see `Quadratic.prior_weight`.
    """
    weight = max(len(baseline.jacobian) / N_EFFECTIVE, 1.0)
    sigmas = np.array([parameter.prior_sigma for parameter in baseline.quadratic.parameters])
    priors = math.sqrt(weight) / sigmas
    known = np.vstack([baseline.jacobian, np.diag(priors)])
    basis, _ = np.linalg.qr(known)
    found = {}
    for one in screened:
        signature = np.vstack([one.signature, np.zeros((len(priors), one.signature.shape[1]))])
        found[one.id] = signature - basis @ (basis.T @ signature)
    return found


def not_resolvable(signatures: Mapping[str, Float64]) -> tuple[tuple[str, str], ...]:
    """Return the pairs of effects that look the same."""
    names = [name for name, signature in signatures.items() if np.linalg.norm(signature) > 0.0]
    spans = {name: _span(signatures[name]) for name in names}
    pairs = []
    for n, one in enumerate(names):
        for other in names[n + 1 :]:
            small, large = sorted((spans[one], spans[other]), key=lambda span: span.shape[1])
            # The least cosine between the smaller span and the larger: all of it must lie within.
            if small.shape[1] and np.linalg.svd(large.T @ small, compute_uv=False).min() > ALIKE:
                pairs.append((one, other))
    return tuple(pairs)


def _span(signature: Float64) -> Float64:
    """Return an orthonormal basis (n, k) of a signature's columns that do something."""
    sizes = np.linalg.norm(signature, axis=0)
    basis, weight, _ = np.linalg.svd(signature / np.maximum(sizes, 1e-12), full_matrices=False)
    return np.asarray(basis[:, weight > 1e-3])


def smallest(signatures: Mapping[str, Float64], screened: Sequence[Screened]) -> dict[str, Estimate]:
    """Return the least magnitude of each effect that would show; those that never do are left out."""
    found = {}
    for one in screened:
        n = len(one.signature)
        per_unit = float(np.sum(signatures[one.id][:, 0] ** 2)) / n
        evidence = NAMED_FROM + cost_nats(len(REGISTRY[one.id].parameters))
        needed = math.expm1(2.0 * evidence / N_EFFECTIVE)
        if per_unit > 0.0:
            moved = int(np.flatnonzero(one.steps[0])[0])
            step, unit = float(one.steps[0, moved]), REGISTRY[one.id].parameters[moved].unit
            found[one.id] = Estimate(abs(step) * math.sqrt(needed / per_unit), math.nan, unit)
    return found
