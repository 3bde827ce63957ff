"""A first look at effects and pairs, without a fit: the evidence along probe points, and where fits start.

The residual is taken as linear between no effect and each probe point, and in the nuisances. Along these
lines the evidence of each effect has a closed form, and that of each pair.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.effects import Effects, Values
from sim_to_real.evidence.error_model import ErrorModel, LinearHypothesis, SizeColumns, probe_sigmas
from sim_to_real.evidence.evidence_table import Blocks, EvidenceTable
from sim_to_real.fit.gauss_newton import Refit
from sim_to_real.search.score_test import ScoreTest

START_SHARES = 1.0, 0.4, 0.1
"""At these shares of the likeliest step a fit may start: at the one where least is left."""


@dataclass(frozen=True, eq=False)
class PairLook:
    """Two effects that are worth a fit: from any of some starts, at some nuisances."""

    starts: Sequence[Effects]
    nuisance: Float64

    @property
    def ids(self) -> frozenset[str]:
        """The two effects."""
        return frozenset(self.starts[0])


@dataclass(frozen=True, eq=False)
class Looks:
    """A first look from a fit without effects: its hypothesis, its nuisances (n,), the effects' scores."""

    at_start: LinearHypothesis
    nuisance: Float64
    scores: Sequence[ScoreTest]
    errors: ErrorModel

    @cached_property
    def none(self) -> float:
        """The evidence of no gap about the start: what looks from there gain on."""
        return self.errors.log_evidence(self.at_start)

    def evidence(self, score: ScoreTest) -> float:
        """Return the evidence along an effect's probe points, the best family's, its form exact or off."""
        likeliest = self._ranked(score)[0]
        best = self._columns[likeliest]
        form = self.errors.form_error(score.id, best.changes.sum(axis=1))
        return max(self._exact[likeliest], self.errors.log_evidence(self.at_start, best, form))

    def starts_of(self, score: ScoreTest) -> list[Effects]:
        """Return starts for fits of an effect, along its likeliest families."""
        return [start for n in self._ranked(score)[:3] for start in self._starts(self._probes, n)]

    def _starts(self, table: EvidenceTable, *families: int) -> list[Effects]:
        """Return effects at shares of the likeliest steps along some families, by number, fitted together."""
        sizes = table.likeliest(*families)
        return [
            dict(self._along(n, share * size) for n, size in zip(families, sizes, strict=True))
            for share in START_SHARES
        ]

    def _along(self, n: int, sizes: Float64) -> tuple[str, Values]:
        """Return an effect and its parameters at some sizes (k,) of its n-th family's probe points."""
        family = self._families[n]
        low, high = np.array(family.step_limits()).T
        return family.id, family.parameters_along(np.clip(sizes / probe_sigmas(family), low, high))

    @cached_property
    def _families(self) -> list[ScoreTest]:
        return [family for score in self.scores for family in score.families]

    @cached_property
    def _columns(self) -> list[SizeColumns]:
        return [SizeColumns.along_probes(family) for family in self._families]

    @cached_property
    def _blocks(self) -> Blocks:
        return self.errors.blocks(self._columns)

    @cached_property
    def _probes(self) -> EvidenceTable:
        return self.errors.table(self.at_start, self._blocks)

    @cached_property
    def _exact(self) -> list[float]:
        return [self._probes.log_evidence(n) for n in range(len(self._families))]

    def _ranked(self, score: ScoreTest) -> list[int]:
        """Return an effect's families, by number among all, the likeliest first."""
        own = [n for n, family in enumerate(self._families) if family.id == score.id]
        return sorted(own, key=lambda n: -self._exact[n])

    def pairs_with(self, fitted: Refit, exact: float, needed: float) -> list[PairLook]:
        """Return pairs of a fit's effect and another one that gains `needed` nats in addition to it.

        `exact` is the fit's own evidence.
        """
        table = self.errors.table(LinearHypothesis.of(fitted), self._blocks)
        gains: dict[tuple[int, ...], float] = {
            (n,): table.log_evidence(n) - exact
            for n, family in enumerate(self._families)
            if family.id not in fitted.ids
        }
        return [
            # What changes in the course of the weld comes last: its amplitudes end the parameters.
            PairLook([{**start, **fitted.effects} for start in self._starts(table, n)], fitted.nuisance)
            for (n,) in self._worth_fitting(gains, needed)
        ]

    def pairs_alone(self, needed: float) -> list[PairLook]:
        """Return pairs that gain `needed` nats over every single effect at the start."""
        # Pairs are formed of each effect's two best families.
        places = [n for score in self.scores for n in self._ranked(score)[:2]]
        alone = max(self._exact)
        gains: dict[tuple[int, ...], float] = {
            pair: self._probes.log_evidence(*pair) - alone
            for pair in itertools.combinations(places, 2)
            if self._families[pair[0]].id != self._families[pair[1]].id
        }
        return [
            PairLook(self._starts(self._probes, *pair), self.nuisance)
            for pair in self._worth_fitting(gains, needed)
        ]

    def _worth_fitting(self, gains: Mapping[tuple[int, ...], float], needed: float) -> list[tuple[int, ...]]:
        """Return the families, by number, that gain as much as is needed, once for the same effects."""
        best: dict[tuple[str, ...], tuple[int, ...]] = {}
        for families in sorted(gains, key=lambda families: -gains[families]):
            if gains[families] > needed:
                best.setdefault(tuple(self._families[n].id for n in families), families)
        return list(best.values())[:2]
