"""The constants of the judgement, in one record: what the model's own error is like, and the prior odds."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Policy:
    """What is taken for granted when hypotheses are compared.

    How many verdicts flip where a constant is 20 % smaller or larger is measured on opened blind checks:
    docs/research/blind_check.md, `benchmarks/policy_sensitivity.py`.

    Attributes
    ----------
    negligible : float
        1 sigma of what every effect may be off in a recording without a gap. Unit: sigma of its prior.
        Source: chosen, with the next three, so that quiet recordings of an independent renderer have no gap.
    negligible_rms : float
        Its root mean square over all bins is no larger than this. Unit: sigma of the bins' noise.
    image_rel, frame_rel : float
        1 sigma of the model's own smooth error over the image and from frame to frame. Unit: share of the
        light. Against a path tracer the model's blocks are off by up to 0.8 %: docs/research/path_tracer.md.
    tail_dof : float
        Degrees of freedom of Student's distribution, from which robust weights come. Source: chosen,
        between few, which give outliers little weight, and a normal distribution (Lange, Little and Taylor
        1989, J. Am. Stat. Assoc. 84, 881).
    n_bins : int
        So many bins are compared, half of them in the stripe. Source: neighbours say much the same, and the
        time grows with their number.
    max_ripple : float
        Bins resolve a stripe whose fourth difference is no larger than this. Unit: share of its light.
        Source: one that they do not resolve is off without a gap by 1.06 sigmas at 0.9, by 1.44 at 1.8.
    temperature : float
        The log evidence counts divided by this: what the error model leaves out. Source: chosen;
        at 2 to 4.5 as many verdicts on an opened check are right.
    ln_odds_effect, ln_odds_further, ln_odds_unknown : float
        Prior odds against no gap: of one effect of the catalogue, of a further cause, of an unknown one.
        Unit: nats. Source: an effect of the catalogue is a third as probable as no gap, a second cause beside
        it a twentieth of that, and one that the catalogue lacks a fiftieth as probable as no gap; on opened
        checks the first names nothing in 148 quiet recordings, and 0 names a blooming of 0.52 in one.
    free_sizes : tuple of float
        1 sigma of an unknown cause's term; all equally probable. Unit: share of the light that it changes.
        Source: chosen, from what the model may be off to half of the light.
    named, possible : float
        Probability from which on an effect is named, and from which on it is in an ambiguity set. Source:
        chosen: of names given at 0.9 one in ten is wrong.
    """

    negligible: float = 0.05
    negligible_rms: float = 0.1
    image_rel: float = 0.004
    frame_rel: float = 0.003
    tail_dof: float = 6.0
    n_bins: int = 9000
    max_ripple: float = 1.0
    temperature: float = 3.0
    ln_odds_effect: float = -1.0
    ln_odds_further: float = -3.0
    ln_odds_unknown: float = -4.0
    free_sizes: tuple[float, ...] = (0.02, 0.1, 0.5)
    named: float = 0.9
    possible: float = 0.05


POLICY = Policy()
"""The policy of every posterior."""
