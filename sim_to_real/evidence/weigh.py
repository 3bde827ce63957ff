"""The posterior over all hypotheses about a recording's gap: looked at, fitted as far as needed, weighed."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sim_to_real.evidence.error_model import ErrorModel
from sim_to_real.evidence.hypotheses import Posterior
from sim_to_real.evidence.hypothesis_search import HypothesisSearch
from sim_to_real.evidence.policy import POLICY
from sim_to_real.fit.gauss_newton import Refit, refit
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.nuisances import BIASED_MEAN_SQUARE
from sim_to_real.locate.covariates import Covariates
from sim_to_real.search.probe_points import FAMILIES
from sim_to_real.search.score_test import score_effects


def weigh(
    model: LinearizedModel,
    before: Refit,
    of_bins: Covariates,
    without: Sequence[str],
    on_stage: Callable[[str, float], None],
) -> Posterior:
    """Weigh all hypotheses about what a fit without effects leaves; effects `without` are no candidates."""
    model, start = model.anchored_at(before.nuisance, {}), before
    if before.mean_square > BIASED_MEAN_SQUARE:
        # A large gap biases the nuisances so far that no effect could fit: start from the stated values.
        model = model.anchored_at(model.neutral, {})
        start = refit(model, {}, model.neutral, steps=0)
    scores = score_effects(model, start, [name for name in FAMILIES if name not in without])
    errors = ErrorModel.of(model, of_bins, start, scores, POLICY)
    search = HypothesisSearch(model, start, scores, errors, POLICY, without, on_stage)
    fits = [before] if start is before else [before, start]
    without_effects = [search.settled(search.hypothesis(fit)) for fit in fits]
    tables = [search.free_terms_beside(hypothesis) for hypothesis in without_effects]
    none = search.none(without_effects[0], without_effects[1:])
    singles = search.singles(none, search.unknown(tables))
    every = search.compared([*singles, *search.pairs(singles, none)])
    # The fits may have come to nuisances about which no gap or an unknown cause is likelier.
    unknown = search.unknown([*tables, *(search.free_terms_beside(single) for single in singles[:1])])
    none = search.none(without_effects[0], [*without_effects[1:], *every])
    return Posterior.of(none, every, unknown, len(scores), POLICY)
