"""Beside other methods: sbi's misspecification tests and the cosine baseline on folders of the blind check.

    python benchmarks/misspecification.py CHECK… [--sample N] [--workers N] [--alpha P] [--out FILE]
    python benchmarks/misspecification.py check-1 check-2 --workers 2 --out misspecification.json

CHECK is a folder of `python -m validation.blind_check make`. It needs sbi 0.27 (`pip install sbi`, which
brings PyTorch), best in an environment of its own. FILE keeps what is done: it goes on from there, and prints
the table again without sbi. Labels are opened for the table alone, once all recordings are tested. Results of
`python -m validation.blind_check run` stand beside them.

*Is there a gap?* For each recording 2300 others are drawn that the nominal model could have made: nuisances
within their priors and tolerances, the camera's with where it makes the tracker see the seam; the model's own
error over the image, from frame to frame and in the stripe, as the diagnosis allows it; noise as stated, with
a read noise within its tolerance, and with an evenly drawn share of the model's floor. The model is linear
about the fit without effects, and the bins are those that the diagnosis compares. Of all of them the
likeliest nuisances and errors are subtracted. What is left, e, in sigmas, is summarised in one of two ways:

- *free terms*: |P e|^2 / rank for each free term of `sim_to_real.evidence.coordinates`, with P the projector
  onto what is left of its functions; some 24 numbers;
- *cells*: the mean of e^2 for each stratum in 3 x 4 cells of the image; at most 48 numbers.

Their cube roots are nearly normal (Wilson and Hilferty 1931), and are whitened by mean and covariance of the
draws. sbi then says how probable such a summary is: `calc_misspecification_mmd` by the maximum mean
discrepancy to the draws, `calc_misspecification_logprob` by the density of a masked autoregressive flow that
is fitted to 2000 of them, ranked among the other 300. A p-value below P is a gap. Then the same without p: a
gap is what exceeds every recording that hides nothing. That threshold is taken from the labels: what the test
could do without a false alarm, had it known them.

Beside sbi stands a test by distortions (Anau Montel, Alvey and Weniger 2024, arXiv 2412.15100), which needs
no network where the model is linear: each column of the free terms, as far as the nuisances leave it, is a
distortion n, and t = n.e / |n| its matched filter. Each t is held against its own distribution among the
draws, so no amplitude has to be chosen. The *largest* of the t^2, or their *sum*, ranks among those of the
draws.

*Which effect?* The cosine of the raw residual with each effect's signature (`validation.blind_check.cosine`),
as the check's results hold it. What a method fails on counts as a wrong answer. Bounds are Wilson's 95 %.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time
import warnings
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from arctrack.output import write_whole
from arctrack.recording import BadFrame, pose_at, read_recording
from noise_model.compiled.arrays import Float32, Float64
from sim_to_real.data.binned import observe, variances_dn2
from sim_to_real.evidence.coordinates import free_terms
from sim_to_real.evidence.error_model import (
    LinearHypothesis,
    compared_bins,
    sampling_error,
    smooth_error,
)
from sim_to_real.evidence.policy import POLICY
from sim_to_real.fit.covariates import Covariates, covariates
from sim_to_real.fit.gauss_newton import Refit, refit
from sim_to_real.fit.linearized_model import LinearizedModel
from validation.blind_check.blind_check import RECORDINGS, RESULTS, SEALED, cases
from validation.blind_check.case import Case
from validation.blind_check.files import SealedFile, read_check_file
from validation.blind_check.score import Rate

N_FITTED, N_VALIDATION = 2000, 300
"""Draws that the flow is fitted to and the discrepancy taken to, and those that densities rank among."""

SHUFFLES = {"n_shuffle": 500, "max_samples": 500}
"""Of the maximum mean discrepancy."""

TRAINING = {"training_batch_size": 250, "learning_rate": 2e-3, "stop_after_epochs": 4}
"""Of the flow: the loss is that of sbi's own settings, in an eighth of the time."""

CELLS = (3, 4)
"""Cells of the image over rows and columns."""

MIN_BINS = 20
"""A cell with fewer bins is left out."""

MIN_EIGENVALUE_REL = 1e-6
"""Directions with a smaller share of the largest variance are rounding."""

TESTS, SUMMARIES = ("log-prob", "MMD"), ("free terms", "cells")
DISTORTIONS, AGGREGATES = "distortions", ("largest", "sum")
EVERY_TEST = (*itertools.product(TESTS, SUMMARIES), *((name, DISTORTIONS) for name in AGGREGATES))
"""Each test with what it is of."""

ARCTRACK, COSINE = "arctrack", "cosine of the raw residual"


@dataclass(frozen=True, eq=False)
class Nominal:
    """What the nominal model could have recorded in some bins (n,), whitened, linear in standard normals.

    `recorded` (n,) are the residuals at the priors' means, `columns` (n, p) what one prior sigma of each
    nuisance and of the model's own errors adds. Of the bins' variances these are shares (n,): the
    stated `noise`, `read` noise alone, whose size is known within `read_noise_rel`, and the model's `floor`,
    the most that it may be off by in single bins.
    """

    recorded: Float32
    columns: Float32
    noise: Float32
    read: Float32
    floor: Float32
    read_noise_rel: float

    def draw(self, count: int, rng: np.random.Generator) -> Float32:
        """Return so many recordings (count, n)."""
        sizes = rng.standard_normal((count, self.columns.shape[1]), dtype=np.float32)
        drawn = rng.standard_normal((count, len(self.recorded)), dtype=np.float32)
        ratio = 1.0 + self.read_noise_rel * rng.standard_normal((count, 1), dtype=np.float32)
        variance = self.noise + (ratio**2 - 1.0) * self.read
        variance += rng.random((count, 1), dtype=np.float32) * self.floor
        drawn *= np.sqrt(np.maximum(variance, 0.0))
        drawn += sizes @ self.columns.T
        return drawn

    def remainder(self, residuals: Float32) -> Float32:
        """Return what the likeliest sizes leave of residuals (k, n)."""
        sizes = np.linalg.solve(self._information, (residuals @ self.columns).T.astype(np.float64))
        return np.asarray(residuals - sizes.T.astype(np.float32) @ self.columns.T)

    @cached_property
    def _information(self) -> Float64:
        columns = self.columns.astype(np.float64)
        return columns.T @ columns + np.eye(columns.shape[1])


Summary = Callable[[Float32], Float64]
"""Makes summaries (k, d) of what is left of recordings (k, n)."""


def nominal_of(path: Path) -> tuple[Nominal, dict[str, Summary], Float32]:
    """Return what the nominal model says of a recording's bins, their summaries by name, and distortions.

    The distortions (n, m) are the free terms' columns that nuisances do not take on.
    """
    recording = read_recording(path)
    frames = [frame for frame in recording.frames() if not isinstance(frame, BadFrame)]
    model = LinearizedModel(observe(recording.setup, frames, partial(pose_at, recording.pose_buffer())))
    model, fitted = without_effects(model)
    of_bins = covariates(model, fitted)
    bins = compared_bins(model, of_bins, fitted, POLICY)
    model, chosen = model.with_bins(bins), of_bins.subset(bins)
    fitted = refit(model, {}, fitted.nuisance, steps=0)
    linear = LinearHypothesis.of(fitted)
    tolerance = recording.setup.tolerance
    errors = [smooth_error(chosen, POLICY), sampling_error(model, chosen, fitted)]
    columns = np.hstack([linear.columns.changes, *errors])
    shares = noise_shares(model, fitted)
    single = (values.astype(np.float32) for values in (linear.residuals, columns, *shares))
    nominal = Nominal(*single, tolerance.read_noise_rel)
    left = [nominal.remainder(columns.T).T for columns in free_terms(chosen).columns]
    summaries = dict(zip(SUMMARIES, (of_spans(left), of_cells(chosen)), strict=True))
    return nominal, summaries, np.hstack(left)


def without_effects(model: LinearizedModel) -> tuple[LinearizedModel, Refit]:
    """Fit the nuisances alone; return the model about them, with edges masked, and the fit."""
    model = model.anchored_at(model.neutral, {})
    first = refit(model, {}, model.neutral)
    model.mask_edges(first.nuisance, {})
    model.widen_noise_for_bends(first.nuisance, {})
    model = model.anchored_at(first.nuisance, {})
    return model, refit(model, {}, first.nuisance)


def noise_shares(model: LinearizedModel, fitted: Refit) -> tuple[Float64, Float64, Float64]:
    """Return the shares (n,) of bins' variances: of the noise as stated, of read noise, of the floor."""
    parts = []
    for frame, light in zip(model.observed.frames, fitted.lights, strict=True):
        stated_dn2, floor_dn2 = variances_dn2(frame.kept_dn, model.observed.setup)
        read_dn2 = (light.dn_per_e() * light.sensor.read_noise_e) ** 2
        per_dn2 = 1.0 / (model.observed.bin_px * frame.sigma_dn) ** 2
        noise = stated_dn2 * per_dn2
        parts.append((noise, np.minimum(read_dn2 * per_dn2, noise), floor_dn2 / frame.sigma_dn**2))
    noise, read, floor = (np.concatenate(shares) for shares in zip(*parts, strict=True))
    return noise, read, floor


def of_spans(spans: Sequence[Float32]) -> Summary:
    """Return the summary (|P e|^2 / rank)^(1/3) by the projectors P onto spans of columns (n, k)."""
    bases = []
    for columns in spans:
        values, vectors = np.linalg.eigh(columns.T.astype(np.float64) @ columns)
        kept = values > MIN_EIGENVALUE_REL * max(float(values.max(initial=0.0)), 1e-12)
        if kept.any():
            bases.append(columns @ (vectors[:, kept] / np.sqrt(values[kept])).astype(np.float32))
    starts = np.cumsum([0, *(basis.shape[1] for basis in bases[:-1])])
    ranks = np.array([basis.shape[1] for basis in bases])
    every = np.hstack(bases)
    return lambda e: np.cbrt(np.add.reduceat((e @ every).astype(np.float64) ** 2, starts, axis=1) / ranks)


def of_cells(of_bins: Covariates) -> Summary:
    """Return the summary (mean e^2)^(1/3) over the bins of each stratum in each cell of the image."""
    row, column = (
        np.minimum((count * values / (values.max() + 1.0)).astype(np.int64), count - 1)
        for count, values in zip(CELLS, (of_bins.values["row"], of_bins.values["column"]), strict=True)
    )
    cell = (of_bins.stratum.astype(np.int64) * CELLS[0] + row) * CELLS[1] + column
    _, place, counts = np.unique(cell, return_inverse=True, return_counts=True)
    means = (place[:, np.newaxis] == np.flatnonzero(counts >= MIN_BINS)).astype(np.float32)
    means /= means.sum(axis=0)
    return lambda e: np.cbrt((e**2 @ means).astype(np.float64))


def whitened(observed: Float64, drawn: Float64) -> tuple[Float64, Float64]:
    """Return an observed summary (1, d) and drawn ones (k, d) whitened by the drawn ones: (1, m), (k, m)."""
    mean = drawn.mean(axis=0)
    variances, directions = np.linalg.eigh(np.atleast_2d(np.cov(drawn, rowvar=False)))
    kept = variances > MIN_EIGENVALUE_REL * variances.max()
    scaled = directions[:, kept] / np.sqrt(variances[kept])
    return (observed - mean) @ scaled, (drawn - mean) @ scaled


def distortions_say(recorded: Float32, drawn: Float32, distortions: Float32) -> dict[str, dict[str, float]]:
    """Return what matched filters of distortions (n, m) say of a recording (1, n) among draws (k, n)."""
    seen = np.linalg.norm(distortions, axis=0)
    directions = distortions[:, seen > MIN_EIGENVALUE_REL * seen.max()]
    squares = np.square((np.vstack([recorded, drawn]) @ directions).astype(np.float64))
    # Each is scaled by its own draws: the model's errors leave some more than noise.
    squares /= squares[1:].mean(axis=0)
    said = {}
    for name, of_all in zip(AGGREGATES, (squares.max(axis=1), squares.sum(axis=1)), strict=True):
        own, others = of_all[0], of_all[1:]
        p = (1.0 + np.count_nonzero(others >= own)) / (1.0 + len(others))
        said[name] = {"p": float(p), "excess": float(own / others.mean()), "is_off": 0.0}
    return said


class _NoLog:
    """Takes what sbi logs of a training, which otherwise goes into a folder of TensorBoard's."""

    log_dir = None

    def log_metric(self, name: str, value: float, step: int | None = None) -> None:
        pass

    def flush(self) -> None:
        pass


def sbi_says(observed: Float64, drawn: Float64, seed: int) -> dict[str, dict[str, float]]:
    """Return what sbi's tests say of an observed summary (1, d) among drawn ones (k, d), by test.

    That is the p-value `p` and the `excess` of the statistic: by how many nats the log density is lower than
    that of draws is on average, and the discrepancy over that of draws. `is_off` is 1 if sbi warned that the
    flow is not the distribution of the draws.
    """
    # Here, so that the command line is read, and a table printed, without it.
    import torch
    from sbi.diagnostics.misspecification import calc_misspecification_logprob, calc_misspecification_mmd
    from sbi.inference.trainers.marginal import MarginalTrainer

    torch.set_num_threads(1)
    torch.manual_seed(seed)
    x_o, x = (torch.as_tensor(values, dtype=torch.float32) for values in whitened(observed, drawn))
    reference, validation = x[:N_FITTED], x[N_FITTED:]
    p_mmd, (among_draws, mmd) = calc_misspecification_mmd(x_o, reference, **SHUFFLES)
    trainer = MarginalTrainer(density_estimator="maf", tracker=_NoLog(), show_progress_bars=False)
    flow = trainer.append_samples(reference).train(**TRAINING)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        p_density, _ = calc_misspecification_logprob(validation, x_o, flow)
    is_off = any("c2st" in str(warning.message) for warning in warned)
    with torch.no_grad():
        lower = float(flow.log_prob(validation).mean() - flow.log_prob(x_o).sum())
    return {
        "log-prob": {"p": float(p_density), "excess": lower, "is_off": float(is_off)},
        "MMD": {"p": float(p_mmd), "excess": float(mmd / among_draws.mean())},
    }


def tested(path: Path) -> dict[str, Any]:
    """Return what is said of a recording by summary and test, and the seconds; or the problem."""
    started = time.process_time()
    seed = zlib.crc32(path.name.encode())
    try:
        with threadpool_limits(1, user_api="blas"):
            nominal, summaries, distortions = nominal_of(path)
            drawn = nominal.draw(N_FITTED + N_VALIDATION, np.random.default_rng(seed))
            drawn, recorded = nominal.remainder(drawn), nominal.remainder(nominal.recorded[np.newaxis])
            prepared_s = time.process_time() - started
            said = {name: sbi_says(of(recorded), of(drawn), seed) for name, of in summaries.items()}
            said[DISTORTIONS] = distortions_say(recorded, drawn, distortions)
    except ImportError:
        raise
    except Exception as error:
        # As in the check: a recording that fails is a wrong answer, not the end.
        return {"problem": f"{type(error).__name__}: {error}"}
    return {"said": said, "prepared_s": prepared_s, "cpu_s": time.process_time() - started}


def test_recordings(paths: Mapping[str, Path], workers: int, out: Path) -> dict[str, Any]:
    """Return what is said of recordings, by their seals; those that a file does not hold yet are tested."""
    kept: dict[str, Any] = json.loads(out.read_text()) if out.exists() else {}
    missing = {seal: path for seal, path in paths.items() if seal not in kept}
    with ProcessPoolExecutor(workers) as executor:
        futures = {executor.submit(tested, path): seal for seal, path in missing.items()}
        for n_done, future in enumerate(as_completed(futures), len(paths) - len(missing) + 1):
            seal, result = futures[future], future.result()
            kept[seal] = {"recording": str(paths[seal]), **result}
            write_whole(out, json.dumps(kept, indent=1) + "\n")
            print(f"{n_done} of {len(paths)}: {paths[seal]}: {in_words(result)}", flush=True)
    return kept


def sampled(folder: Path, count: int | None) -> dict[str, str]:
    """Return the seals of so many of a check's recordings, by name; all of them without a count."""
    sealed = read_check_file(folder / SEALED, SealedFile)["recordings"]
    names = sorted(sealed)
    order = np.random.default_rng(0).permutation(len(names))
    return {names[n]: sealed[names[n]]["sha256"] for n in sorted(order[:count])}


def in_words(result: dict[str, Any]) -> str:
    if "problem" in result:
        return str(result["problem"])
    p = (f"{test} of {name} {of[test]['p']:.3f}" for name, of in result["said"].items() for test in of)
    return f"p by {', '.join(p)} ({result['cpu_s']:.0f} s)"


@dataclass(frozen=True)
class Judged:
    """A recording of the check and what the tests say of it; `is_diagnosed` if arctrack has a result."""

    case: Case
    result: dict[str, Any]
    is_diagnosed: bool

    def says_gap(self, summary: str, test: str, is_gap: Callable[[dict[str, float]], bool]) -> bool:
        """Say whether a test calls it a gap; a test that failed says what is wrong."""
        if "problem" in self.result:
            return not self.case.effects
        return is_gap(self.result["said"][summary][test])

    def is_called_gap(self) -> bool:
        """Say whether arctrack calls it a gap; a diagnosis that failed is wrong."""
        return self.case.answer.says_gap if self.case.effects else self.case.answer.verdict != "no_gap"


def table(judged: Sequence[Judged], alpha: float) -> str:
    """Return the table in Markdown: a row for each method, a column for each question and tier."""
    hiding = [tier for tier in "ACDF" if any(j.case.tier == tier for j in judged)]
    diagnosed = [j for j in judged if j.is_diagnosed]

    def rates(some: Sequence[Judged], says: Callable[[Judged], bool], tiers: Iterable[str]) -> list[str]:
        return [cell([says(j) for j in some if j.case.tier == tier]) for tier in tiers]

    nothing = ["" for _ in hiding]
    gap, first = [f"{tier}, called a gap" for tier in hiding], [f"{tier}, named first" for tier in hiding]
    rows = [["method", "E, called a gap", *gap, *first], ["---"] * (2 + 2 * len(hiding))]
    for text, is_gap in ((f"p < {alpha:g}", by_p(alpha)), ("beyond all of E", None)):
        for test, name in EVERY_TEST:
            decides = is_gap or beyond_quiet(judged, name, test)
            says = partial(Judged.says_gap, summary=name, test=test, is_gap=decides)
            whose = "" if name == DISTORTIONS else "sbi, "
            rows.append([f"{whose}{test} of {name}, {text}", *rates(judged, says, ("E", *hiding)), *nothing])
    rows.append([COSINE, "always", *nothing, *rates(diagnosed, lambda j: j.case.cosine_named_first, hiding)])
    called = rates(diagnosed, Judged.is_called_gap, ("E", *hiding))
    rows.append([ARCTRACK, *called, *rates(diagnosed, lambda j: j.case.named_first, hiding)])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def by_p(alpha: float) -> Callable[[dict[str, float]], bool]:
    return lambda said: said["p"] < alpha


def beyond_quiet(judged: Sequence[Judged], summary: str, test: str) -> Callable[[dict[str, float]], bool]:
    """Return the rule that calls a gap what exceeds every recording that hides nothing."""
    quiet = [
        j.result["said"][summary][test]["excess"] for j in judged if not j.case.effects and "said" in j.result
    ]
    most = max(quiet, default=-math.inf)
    return lambda said: said["excess"] > most


def cell(right: Sequence[bool]) -> str:
    """Return how many of how many, the share, and its bounds."""
    rate = Rate(sum(right), len(right))
    if not right:
        return ""
    low, high = (100.0 * bound for bound in rate.bounds)
    return f"{rate.right} of {rate.of}, {100.0 * rate.share:.0f} % ({low:.0f} to {high:.0f})"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checks", metavar="CHECK", type=Path, nargs="+")
    parser.add_argument("--sample", metavar="N", type=int, help="of each check so many recordings, at random")
    parser.add_argument("--workers", metavar="N", type=int, default=1)
    parser.add_argument("--alpha", metavar="P", type=float, default=0.01, help="below it a p-value is a gap")
    parser.add_argument("--out", metavar="FILE", type=Path, default=Path("misspecification.json"))
    options = parser.parse_args()
    seals = {folder: sampled(folder, options.sample) for folder in options.checks}
    paths = {
        seal: folder / RECORDINGS / name for folder, some in seals.items() for name, seal in some.items()
    }
    results = test_recordings(paths, options.workers, options.out)
    judged = [
        Judged(case, results[some[case.name]], (folder / RESULTS / f"{case.name}.json").exists())
        for folder, some in seals.items()
        for case in cases(folder)
        if case.name in some
    ]
    print(f"\n{table(judged, options.alpha)}")
    seconds = [j.result["cpu_s"] for j in judged if "said" in j.result] or [math.nan]
    said = [j.result["said"][name] for j in judged if "said" in j.result for name in SUMMARIES]
    flows = [of["log-prob"]["is_off"] for of in said]
    print(f"\nProcessor time of all tests, median: {np.median(seconds):.1f} s.")
    print(f"Flows that are not the draws' distribution, as sbi warns: {sum(flows):.0f} of {len(flows)}.")


if __name__ == "__main__":
    main()
