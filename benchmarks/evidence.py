"""The evidence of every hypothesis about a recording: no gap, effects, pairs of them, an unknown cause.

    python benchmarks/evidence.py RECORDING ... [--without EFFECT] ...

`arctrack diagnose` does not judge by it yet. Beside the verdict that the posterior gives stands what each
hypothesis has over no gap, nats, and its probability.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from threadpoolctl import threadpool_limits

from arctrack.recording import pose_at, read_recording
from noise_model.effects import REGISTRY
from sim_to_real.data.binned import observe
from sim_to_real.data.cross_validation import held_out
from sim_to_real.diagnose import HOLDOUT_SHARE, baseline_of
from sim_to_real.diagnosis import excluded_effects
from sim_to_real.evidence.hypotheses import Posterior
from sim_to_real.evidence.judgement import judge
from sim_to_real.evidence.policy import POLICY
from sim_to_real.evidence.weigh import weigh
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.locate.covariates import covariates

MOST = 6
"""So many hypotheses with effects are printed."""


def posterior_of(path: Path, without: list[str]) -> Posterior:
    """Return the posterior of a recording, of the frames that the diagnosis fits."""
    recording = read_recording(path)
    frames, _ = recording.readable_frames()
    poses, setup = recording.pose_buffer(), recording.setup
    observed = observe(setup, frames, lambda timestamp_s: pose_at(poses, timestamp_s)).with_stripe_rim()
    model = LinearizedModel(observed.subset(~held_out(observed, HOLDOUT_SHARE)))
    excluded = excluded_effects(setup, without)
    before, _ = baseline_of(model, excluded)
    values = covariates(model, before)
    return weigh(model, before, values, excluded, _tell)


def _tell(text: str, share: float) -> None:
    print(f"  {text} …", file=sys.stderr, flush=True)


def print_posterior(path: Path, without: list[str]) -> None:
    began_s = time.process_time()
    with threadpool_limits(1, user_api="blas"):
        posterior = posterior_of(path, without)
    judgement = judge(posterior, POLICY)
    named = ", ".join(judgement.named) or " or ".join(name for ids in judgement.ambiguous for name in ids)
    took_s = time.process_time() - began_s
    print(f"{path.name}: {judgement.verdict.value} {named} ({took_s:.0f} s of CPU)")
    none = posterior.none.evidence
    stage, term = posterior.unknown.likeliest
    print(f"  {'no gap':48} {0.0:9.1f} {posterior.p_none:7.3f}")
    unknown = f"unknown: {stage.value}, {term}"
    print(f"  {unknown:48} {posterior.unknown.evidence - none:9.1f} {posterior.p_unknown:7.3f}")
    for hypothesis, p in list(zip(posterior.hypotheses, posterior.p, strict=True))[:MOST]:
        changes = "" if hypothesis.refit.trend is None else f" by {hypothesis.refit.trend.driver.value}"
        name = " and ".join(hypothesis.ids) + changes
        print(f"  {name:48} {hypothesis.evidence - none:9.1f} {p:7.3f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--without", action="append", default=[], choices=list(REGISTRY))
    options = parser.parse_args()
    for path in options.recordings:
        print_posterior(path, options.without)


if __name__ == "__main__":
    main()
