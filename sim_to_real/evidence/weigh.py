"""The posterior over all hypotheses about a recording's gap: looked at, fitted as far as needed, weighed."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from noise_model.compiled.arrays import Float64, Int64
from noise_model.effects import REGISTRY, not_predicted
from noise_model.fit import within_bounds
from sim_to_real.diagnosis import DiagnosisVerdict, ParameterEstimate
from sim_to_real.evidence.confidence import closed_in_bins, need_probability
from sim_to_real.evidence.error_model import ErrorModel, LinearHypothesis, compared_bins
from sim_to_real.evidence.hypotheses import Hypothesis, Posterior
from sim_to_real.evidence.hypothesis_search import HypothesisSearch, best_of_each
from sim_to_real.evidence.policy import POLICY, Policy
from sim_to_real.fit.covariates import Covariates
from sim_to_real.fit.gauss_newton import Refit, refit
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.nuisances import BIASED_MEAN_SQUARE
from sim_to_real.search.score_test import FAMILIES, ScoreTest, score_effects

MIN_NATS = 3.0
"""The evidence over no gap from which on an effect shows."""

MIN_CLOSES = 0.1
"""Least share of the bins' gap that an effect closes that others may be indistinguishable from."""


@dataclass(frozen=True, eq=False)
class WeightedHypotheses:
    """The posterior, with the effects' scores, the error model and the linear form of no gap behind it.

    `bins` (n,) are the places of the bins that are compared among all.
    """

    posterior: Posterior
    scores: tuple[ScoreTest, ...]
    errors: ErrorModel
    start: LinearHypothesis
    bins: Int64
    policy: Policy = POLICY

    def without(self, refuted: Hypothesis) -> "WeightedHypotheses":
        """Return the same without a hypothesis that other frames have refuted."""
        posterior = self.posterior
        kept = [hypothesis for hypothesis in posterior.hypotheses if hypothesis is not refuted]
        weighed = Posterior.of(posterior.none, kept, posterior.unknown, len(self.scores), self.policy)
        return replace(self, posterior=weighed)

    @property
    def not_resolvable(self) -> tuple[tuple[str, str], ...]:
        """Pairs of effects that this recording cannot separate, by what their probe points change."""
        seen, blocks, pairs = self._seen, self._blocks, []
        for n, m in itertools.combinations(range(len(blocks)), 2):
            cosines = principal_cosines(
                seen[blocks[n], blocks[n]], seen[blocks[n], blocks[m]], seen[blocks[m], blocks[m]]
            )
            # All of the smaller span must lie within the larger: the smallest cosine counts.
            if len(cosines) and cosines.min() > 0.98:
                pairs.append((self.scores[n].id, self.scores[m].id))
        return tuple(pairs)

    @property
    def smallest(self) -> dict[str, ParameterEstimate]:
        """The smallest magnitude of each effect whose evidence would show, if any would."""
        magnitudes = {}
        for score, block in zip(self.scores, self._blocks, strict=True):
            per_square = float(self._seen[block.start, block.start])
            # Where light ends is a place, and has no magnitude.
            if per_square > 0.0 and score.steps[0].any():
                moved = int(np.flatnonzero(score.steps[0])[0])
                parameter = REGISTRY[score.id].parameters[moved]
                ratio = math.sqrt(2.0 * MIN_NATS / per_square)
                magnitudes[score.id] = ParameterEstimate(
                    abs(float(score.steps[0, moved])) * ratio, math.nan, parameter.unit
                )
        return magnitudes

    @property
    def smallest_values(self) -> dict[str, tuple[dict[str, float], ...]]:
        """The parameters of each effect at which it would just show, a set along each of its probe points."""
        of_each = {}
        for score, block in zip(self.scores, self._blocks, strict=True):
            parameters, sets = REGISTRY[score.id].parameters, []
            origin = np.array(list(score.origin.values()))
            for step, per_square in zip(score.steps, np.diag(self._seen)[block], strict=True):
                # Where light ends is a place, and has no magnitude.
                if per_square > 0.0 and step.any():
                    moved = within_bounds(parameters, origin + step * math.sqrt(2.0 * MIN_NATS / per_square))
                    sets.append(dict(zip(score.origin, moved.tolist(), strict=True)))
            of_each[score.id] = tuple(sets)
        return of_each

    @property
    def _blocks(self) -> list[slice]:
        """Slice of each effect's probe points among those of all."""
        ends = np.cumsum([0, *(score.signature.shape[1] for score in self.scores)])
        return [slice(start, end) for start, end in itertools.pairwise(ends.tolist())]

    @cached_property
    def _seen(self) -> Float64:
        """The products (k, k) of what all probe points change, what nuisances take on projected out."""
        changes = np.hstack([np.zeros((len(self.start.residuals), 0)), *(s.signature for s in self.scores)])
        metric, nuisances = self.errors.metric, self.start.columns.changes
        own, cross = metric.products(changes, changes), metric.products(nuisances, changes)
        information = metric.products(nuisances, nuisances) + np.eye(nuisances.shape[1])
        return np.asarray(own - cross.T @ np.linalg.solve(information, cross))


def principal_cosines(first: Float64, between: Float64, second: Float64) -> Float64:
    """Return the cosines between two spans from the products of their columns, as many as the smaller has."""

    def inverse_root(products: Float64) -> Float64:
        values, vectors = np.linalg.eigh(products)
        # Smaller products are rounding.
        seen = values > 1e-6 * max(float(values.max(initial=0.0)), 1e-12)
        return np.asarray(vectors[:, seen] / np.sqrt(values[seen]))

    return np.asarray(np.linalg.svd(inverse_root(first).T @ between @ inverse_root(second), compute_uv=False))


def weigh(
    model: LinearizedModel,
    before: Refit,
    of_bins: Covariates,
    without: Sequence[str],
    on_stage: Callable[[str, float], None],
    policy: Policy = POLICY,
) -> WeightedHypotheses:
    """Weigh all hypotheses about what a fit without effects leaves; effects `without` are no candidates.

    The model's derivatives are those about that fit.
    """
    bins = compared_bins(model, of_bins, before, policy)
    model, of_bins = model.with_bins(bins), of_bins.subset(bins)
    start = before = refit(model, {}, before.nuisance, steps=0)
    if before.mean_square > BIASED_MEAN_SQUARE:
        # A large gap biases the nuisances so far that no effect could fit: start from the stated values.
        model = model.anchored_at(model.neutral, {})
        start = refit(model, {}, model.neutral, steps=0)
    # Of some effects nothing can be predicted, and some change nothing that the recording shows.
    predicted = [name for name in FAMILIES if name not in not_predicted(model.observed.setup)]
    every_score = [score for score in score_effects(model, start, predicted) if score.is_seen]
    errors = ErrorModel.of(model, of_bins, start, every_score, policy)
    scores = [score for score in every_score if score.id not in without]
    search = HypothesisSearch(model, start, scores, errors, policy, without, on_stage)
    fits = [search.fit([{}], fit.nuisance) for fit in ([before] if start is before else [before, start])]
    without_effects = sorted((search.hypothesis(fit) for fit in fits), key=lambda h: -h.exact)
    term_evidence = [search.free_term_evidence(hypothesis) for hypothesis in without_effects]
    singles = search.singles(without_effects[0], term_evidence)
    # The fits may have come to nuisances about which no gap or an unknown cause is likelier.
    term_evidence += [search.free_term_evidence(single) for single in singles[:1]]
    unknown = search.unknown(term_evidence)
    fitted = [*singles, *search.pairs(singles, unknown.evidence)]
    of_tolerance = search.within_tolerance(fitted)
    every = search.compared(best_of_each([*fitted, *(h for h in of_tolerance if h.ids)]))
    none = search.none(without_effects[0], [*without_effects[1:], *of_tolerance, *every])
    unknown = search.unknown([*term_evidence, search.free_term_evidence(none)])
    posterior = Posterior.of(none, every, unknown, len(scores), policy)
    some = search.likely_in_full(posterior)
    posterior = Posterior.of(none, some, unknown, len(scores), policy)
    return WeightedHypotheses(posterior, tuple(scores), errors, LinearHypothesis.of(start), bins, policy)


@dataclass(frozen=True, eq=False)
class Judgement:
    """A verdict: `leader` is the hypothesis whose fit is shown, `named` its effects that are named.

    Where an unknown cause acts beside effects, they are named, too. `ambiguous` holds the effects of the
    hypotheses that share the posterior where none is named.
    """

    verdict: DiagnosisVerdict
    leader: Hypothesis
    named: tuple[str, ...]
    ambiguous: tuple[tuple[str, ...], ...]


def judge(posterior: Posterior, policy: Policy) -> Judgement:
    """Return the verdict that a posterior gives.

    What leads decides between no gap, an unknown cause and effects. Effects are named whose probability,
    given that effects are the cause, is `policy.named`; where none is, the hypotheses that are
    `policy.possible` are a set, and so are an effect and those indistinguishable from it. Beside an unknown
    cause the likeliest effects are named, none where it probably acts alone.
    """
    of_effects = sum(posterior.p)
    if posterior.p_none >= max(of_effects, posterior.p_unknown):
        return Judgement(DiagnosisVerdict.NO_GAP, posterior.none, (), ())
    if posterior.p_unknown > of_effects or not posterior.hypotheses:
        leader = posterior.likeliest_with_unknown
        return Judgement(DiagnosisVerdict.UNKNOWN, leader, leader.ids, ())
    weighed = list(zip(posterior.hypotheses, posterior.p, strict=True))
    likely = [hypothesis for hypothesis, p in weighed if p >= policy.possible * of_effects]
    sure = [name for name, p in posterior.of_effects.items() if p >= policy.named * of_effects]
    if sure or len(weighed) < 2:
        leader = next((h for h in likely if set(h.ids) == set(sure)), posterior.hypotheses[0])
        leader = with_needed(leader, posterior, policy)
        if others := indistinguishable_effects(leader, posterior, policy):
            return Judgement(DiagnosisVerdict.AMBIGUOUS, leader, (), ((*leader.ids, *others),))
        return Judgement(
            DiagnosisVerdict.EFFECTS, leader, tuple(n for n in sure or leader.ids if n in leader.ids), ()
        )
    # Where the next ones are many and none of them likely, the first of these stands for them.
    undecided = likely if len(likely) > 1 else posterior.hypotheses[:2]
    members = tuple(dict.fromkeys(name for hypothesis in undecided for name in hypothesis.ids))
    return Judgement(DiagnosisVerdict.AMBIGUOUS, posterior.hypotheses[0], (), (members,))


def with_needed(leader: Hypothesis, posterior: Posterior, policy: Policy) -> Hypothesis:
    """Return a leading hypothesis, or that of one of its effects where the other is probably not needed."""
    probabilities = {name: need_probability(name, leader, posterior, policy.need) for name in leader.ids}
    least = min(probabilities, key=lambda name: probabilities[name])
    rest = [name for name in leader.ids if name != least]
    fewer = [h for h in posterior.hypotheses if list(h.ids) == rest]
    return fewer[0] if probabilities[least] < 0.5 and fewer else leader


def indistinguishable_effects(leader: Hypothesis, posterior: Posterior, policy: Policy) -> tuple[str, ...]:
    """Return the effects that by themselves close as much of the bins' gap as a single effect that leads.

    They leave the same pictures, whatever priors and sizes of the fits make of it. One that closes next to
    nothing has none.
    """
    closes = closed_in_bins(leader, posterior)
    if len(leader.ids) != 1 or not closes > MIN_CLOSES:
        return ()
    return tuple(
        name
        for name, (single, _) in posterior.singles.items()
        if name not in leader.ids and closed_in_bins(single, posterior) >= closes - policy.indistinguishable
    )
