"""Error model of a recording's images without a gap, and of the form of an effect.

Three kinds of error, each a covariance: noise, as the recording's bins have it; the model's own error, smooth
over the image and from frame to frame, and every effect of the catalogue at a negligible size; and the error
of an effect's form, a smooth share of what the effect does, in the coordinates of its stage.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from noise_model.effects import REGISTRY
from noise_model.effects.effect import Stage
from sim_to_real.data.binned import ObservedRecording
from sim_to_real.evidence.coordinates import (
    FreeTerms,
    form_functions,
    frame_indicators,
    free_terms,
    hats_2d,
    texture,
)
from sim_to_real.evidence.evidence_table import Blocks, EvidenceTable
from sim_to_real.evidence.metric import Metric, MetricLoss, compress, robust_weights
from sim_to_real.evidence.policy import Policy
from sim_to_real.fit.covariates import Covariates
from sim_to_real.fit.gauss_newton import Refit
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.search.score_test import ScoreTest


@dataclass(frozen=True, eq=False)
class SizeColumns:
    """Change by one prior sigma of each of some sizes (n, k), and the `sides` (k,) that sizes have.

    See `metric.log_evidence` for sides.
    """

    changes: Float32
    sides: Float64

    @classmethod
    def free(cls, changes: Float32) -> SizeColumns:
        """Return columns of unbounded sizes."""
        return cls(changes, np.zeros(changes.shape[1]))

    @classmethod
    def along_probes(cls, score: ScoreTest) -> SizeColumns:
        """Return the columns of one prior sigma of each of an effect's probe points."""
        low, high = np.array(score.step_limits()).T
        changes = np.asarray(score.signature / probe_sigmas(score), dtype=np.float32)
        return cls(changes, 1.0 * (low == 0.0) - 1.0 * (high == 0.0))

    def joined(self, others: SizeColumns) -> SizeColumns:
        """Return both, side by side."""
        return SizeColumns(
            np.hstack([self.changes, others.changes]), np.concatenate([self.sides, others.sides])
        )


def probe_sigmas(score: ScoreTest) -> Float64:
    """Return the distances (k,) of an effect's probe points, in sigmas of their parameters' priors."""
    sigmas = np.array([parameter.prior_sigma for parameter in REGISTRY[score.id].parameters])
    lengths = np.max(np.abs(score.steps) / sigmas, axis=1)
    # Where light ends is no step of a parameter: the change to its shape counts as one.
    # A column is scaled to one sigma, from a step of 0.05 sigmas or more.
    return np.where(lengths > 0.0, np.maximum(lengths, 0.05), 1.0)


@dataclass(frozen=True, eq=False)
class LinearHypothesis:
    """A hypothesis about its fit: residuals (n,) at its priors' means, and what its sizes change."""

    residuals: Float64
    columns: SizeColumns

    @classmethod
    def of(cls, fitted: Refit) -> LinearHypothesis:
        """Return a fit's linear form."""
        return cls._about(fitted, fitted.residuals, fitted.jacobian, np.ones(len(fitted.x), dtype=np.bool_))

    @classmethod
    def without(
        cls, fitted: Refit, name: str | None, residuals: Float64, by_nuisance: Float64
    ) -> LinearHypothesis:
        """Return a fit's linear form without one of its effects, or without any.

        `residuals` (n,) are those without it, at the fit's other parameters, and `by_nuisance` (n, m) their
        derivatives. The fit's own derivatives would let a level of the laser stand for light that only the
        effect makes.
        """
        jacobian = np.hstack([by_nuisance, fitted.jacobian[:, fitted.n_nuisances :]])
        kept = np.ones(len(fitted.x), dtype=np.bool_)
        for effect, block in fitted.blocks:
            kept[block] = name is not None and effect != name
        return cls._about(fitted, residuals, jacobian, kept)

    def extended(self, *further: SizeColumns) -> LinearHypothesis:
        """Return a hypothesis with further columns."""
        return LinearHypothesis(self.residuals, functools.reduce(SizeColumns.joined, further, self.columns))

    @classmethod
    def _about(cls, fitted: Refit, residuals: Float64, jacobian: Float64, kept: Bool) -> LinearHypothesis:
        """Return the linear form with those parameters that are kept (p,); derivatives are (n, p)."""
        quadratic, parameters = fitted.quadratic, itertools.compress(fitted.quadratic.parameters, kept)
        starts, sigmas = quadratic.prior_starts[kept], quadratic.prior_sigmas[kept]
        J = jacobian[:, kept]
        at_start = residuals + J @ (starts - fitted.x[kept])
        sides = np.array([1.0 * (p.lower == p.start) - 1.0 * (p.upper == p.start) for p in parameters])
        return cls(at_start, SizeColumns(np.asarray(J * sigmas, dtype=np.float32), sides))


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """The errors of a recording's bins (n,), as a metric, and the terms of an unknown cause there."""

    metric: Metric
    free_terms: FreeTerms
    form_functions: Mapping[Stage, tuple[Float32, ...]]
    texture: Float32

    @classmethod
    def of(
        cls,
        model: LinearizedModel,
        covariates: Covariates,
        start: Refit,
        scores: Sequence[ScoreTest],
        policy: Policy,
    ) -> ErrorModel:
        """Return the errors about a fit without effects; `scores` hold what each effect does to the bins."""
        terms, forms = free_terms(covariates), form_functions(covariates)
        effects = [
            np.hstack([SizeColumns.along_probes(family).changes for family in score.families])
            for score in scores
        ]
        floor = [
            smooth_error(covariates, policy),
            sampling_error(model, covariates, start),
        ]
        at_start = LinearHypothesis.of(start)
        every = np.hstack([at_start.columns.changes, *floor, *terms.columns, *effects], dtype=np.float32)
        weights = robust_weights(at_start.residuals, compress(every), policy.tail_dof)
        floor += [
            columns if _is_open(model.observed, score.id) else _negligible(columns, policy)
            for score, columns in zip(scores, effects, strict=True)
        ]
        metric = Metric.of(np.hstack(floor, dtype=np.float32), weights)
        return cls(metric, terms, forms, texture(covariates))

    def log_evidence(self, hypothesis: LinearHypothesis, *further: SizeColumns) -> float:
        """Return ln Z, nats, of a hypothesis, with further columns."""
        every = hypothesis.extended(*further)
        return self.metric.log_evidence(every.residuals, every.columns.changes, every.columns.sides)

    @property
    def loss(self) -> MetricLoss:
        """Loss of residuals in a fit."""
        return MetricLoss(self.metric)

    @functools.cached_property
    def free_blocks(self) -> Blocks:
        """The blocks that free terms are made of."""
        return self.blocks([SizeColumns.free(columns) for columns in self.free_terms.columns])

    def blocks(self, blocks: Sequence[SizeColumns]) -> Blocks:
        """Return blocks of columns that hypotheses may have: `table` tells their evidence."""
        none = np.zeros((len(self.metric.root_weights), 0), dtype=np.float32)
        seen = self.metric.weigh(np.hstack([none, *(block.changes for block in blocks)]))
        return Blocks(tuple(block.sides for block in blocks), seen, seen.products(seen))

    def table(self, hypothesis: LinearHypothesis, blocks: Blocks) -> EvidenceTable:
        """Return the table of a hypothesis' evidence with any of some blocks of columns."""
        columns, residuals = hypothesis.columns, hypothesis.residuals
        own = self.metric.weigh(np.column_stack([columns.changes, residuals]))
        products, between = own.products(own), own.products(blocks.seen)
        table = np.block(
            [
                [products[:-1, :-1], between[:-1], products[:-1, -1:]],
                [between[:-1].T, blocks.products, between[-1:].T],
                [products[-1:, :-1], between[-1:], products[-1:, -1:]],
            ]
        )
        sides = [columns.sides, *blocks.sides]
        ends = np.cumsum([0, *(len(of_block) for of_block in sides)])
        return EvidenceTable(table, np.concatenate(sides), ends, len(residuals))

    def form_errors(self, effect: str, change: Float64 | Float32) -> list[SizeColumns]:
        """Return the errors that an effect's form may have; `change` (n,) is what the effect does.

        They are functions of one coordinate each, the last of all coordinates together.
        """
        return [_form_error(effect, functions, change) for functions in self._form_functions(effect)]

    def form_error(self, effect: str, change: Float64 | Float32) -> SizeColumns:
        """Return the last of `form_errors`, that of all coordinates together."""
        return _form_error(effect, self._form_functions(effect)[-1], change)

    def _form_functions(self, effect: str) -> tuple[Float32, ...]:
        of_effect = REGISTRY[effect]
        return (self.texture,) if of_effect.is_textured else self.form_functions[of_effect.stage]

    def form_errors_apart(self, effect: str, change: Float64 | Float32) -> list[tuple[int, float]]:
        """Return errors of an effect's form where the effect itself does nothing: free blocks, and sizes.

        A second stripe that is blurred puts light where a sharp one puts none. Each is a free function of the
        effect's stage, by number. Its RMS over all bins is a share of that of the effect's change, `change`
        (n,).
        """
        share, stage = REGISTRY[effect].form_rel, REGISTRY[effect].stage
        size = share * math.sqrt(float(np.mean(np.square(change))))
        blocks = [
            term.blocks[0] for term in self.free_terms.terms if term.stage is stage and len(term.blocks) == 1
        ]
        return [(block, size / self._free_rms[block]) for block in blocks]

    @functools.cached_property
    def _free_rms(self) -> list[float]:
        """The root mean square over all bins of each free function of size 1."""
        per_bin = [np.einsum("nk,nk->n", columns, columns) for columns in self.free_terms.columns]
        return [math.sqrt(float(np.mean(squares))) for squares in per_bin]

    def log_evidence_off(self, hypothesis: LinearHypothesis, forms: Sequence[Sequence[SizeColumns]]) -> float:
        """Return ln Z, nats, of a hypothesis with effects whose `forms` are off, each by any of its errors.

        All choices are equally probable: any error of one effect, with the last one of each other effect.
        """
        blocks = list(itertools.chain(*forms))
        ends = np.cumsum([len(errors) for errors in forms])
        last = set((ends - 1).tolist())
        choices = {
            frozenset(last - {end - 1} | {n})
            for end, errors in zip(ends, forms, strict=True)
            for n in range(end - len(errors), end)
        }
        table = self.table(hypothesis, self.blocks(blocks))
        nats = [table.log_evidence(*sorted(choice)) for choice in choices]
        return float(logsumexp(sorted(nats)) - math.log(len(nats)))


def _form_error(effect: str, functions: Float32, change: Float64 | Float32) -> SizeColumns:
    share = np.float32(REGISTRY[effect].form_rel)
    return SizeColumns.free(np.asarray(share * functions * change[:, np.newaxis], dtype=np.float32))


def compared_bins(model: LinearizedModel, covariates: Covariates, before: Refit, policy: Policy) -> Int64:
    """Return the places (n,) of the bins to compare, at most `policy.n_bins`.

    Half of them are in the stripe, if there is one that bins resolve in a fit without effects.
    """
    with_stripe = _is_resolved(covariates, _fourth_differences_dn(model, before), policy.max_ripple)
    draw = np.random.default_rng(0)
    usable = np.isfinite(covariates.sigma_dn)
    chosen = []
    for members in (usable & ~covariates.in_stripe, usable & covariates.in_stripe & with_stripe):
        places = np.flatnonzero(members)
        chosen.append(draw.permutation(places)[: policy.n_bins // 2])
    return np.sort(np.concatenate(chosen))


def _is_open(observed: ObservedRecording, name: str) -> bool:
    """Return True if an effect changes only a metal that was fitted to the stripe."""
    return observed.is_metal_fitted and "material" in REGISTRY[name].needs


def _negligible(columns: Float32, policy: Policy) -> Float32:
    """Return the columns (n, k) of an effect of negligible size, all of its families together."""
    rms = np.sqrt(np.mean(columns**2, axis=0))
    sizes = np.minimum(policy.negligible, policy.negligible_rms / np.maximum(rms, 1e-6))
    return np.asarray(columns * sizes / math.sqrt(columns.shape[1]), dtype=np.float32)


def _fourth_differences_dn(model: LinearizedModel, start: Refit) -> Float64:
    """Return the fourth difference of the laser's light between bins (n,), DN, of all frames' bins."""
    fourth_e = model.laser_fourth_differences(start.nuisance)
    parts = [light.dn_per_e() * of_frame for light, of_frame in zip(start.lights, fourth_e, strict=True)]
    return np.concatenate(parts)


def _is_resolved(covariates: Covariates, fourth_dn: Float64, max_ripple: float) -> bool:
    """Return True if bins resolve the stripe: its fourth difference is at most `max_ripple` of its light."""
    of_stripe = covariates.in_stripe
    ripple, light = np.square(fourth_dn[of_stripe]), np.square(covariates.laser_dn[of_stripe])
    return bool(np.sum(ripple) <= max_ripple**2 * np.sum(light))


def sampling_error(model: LinearizedModel, covariates: Covariates, start: Refit) -> Float32:
    """Return the sampling error (n, 1) of a stripe that bins hardly resolve.

    A kernel whose fourth moment is off by m is off by m / 24 of a fourth difference. Three taps of variance v
    have the fourth moment v, a Gaussian has 3 v^2, so bins are off by about v / 24.
    """
    error_dn = model.observed.binned.camera.psf_sigma_px**2 / 24.0 * _fourth_differences_dn(model, start)
    return np.asarray(error_dn / covariates.sigma_dn, dtype=np.float32)[:, np.newaxis]


def smooth_error(covariates: Covariates, policy: Policy) -> Float32:
    """Return the columns (n, k) of the model's own error over the image, the faces and the frames."""
    per_dn = 1.0 / covariates.sigma_dn
    sources = [covariates.arc_dn * per_dn, covariates.laser_dn * per_dn]
    rows, columns = covariates.values["row"], covariates.values["column"]
    image = hats_2d(rows, columns, 6, 7)
    in_frame = frame_indicators(covariates)
    on_face = covariates.face[:, np.newaxis] == np.unique(covariates.face)
    tilts = [_centre(rows), _centre(columns)]
    over_image = [policy.image_rel * image * source[:, np.newaxis] for source in sources]
    over_faces = [policy.face_rel * on_face * source[:, np.newaxis] for source in sources]
    over_frames = [
        policy.frame_rel * in_frame * (tilt * source)[:, np.newaxis]
        for source in sources
        for tilt in (np.ones_like(source), *tilts)
    ]
    return np.hstack([*over_image, *over_faces, *over_frames], dtype=np.float32)


def _centre(values: Float32) -> Float32:
    """Return values (n,) from -1 to 1."""
    low, high = float(np.min(values, initial=0.0)), float(np.max(values, initial=1.0))
    return np.asarray(2.0 * (values - low) / max(high - low, 1.0) - 1.0, dtype=np.float32)
