"""The constants of the judgement, in one record: what the model's own error is like, and the prior odds."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Policy:
    """What is taken for granted when hypotheses are compared.

    Attributes
    ----------
    negligible : float
        1 sigma of what every effect may be off in a recording without a gap, in sigmas of its prior.
    negligible_rms : float
        Its root mean square over all bins is no larger than this, in sigmas of their noise.
    image_rel, frame_rel : float
        1 sigma of the model's own smooth error over the image and from frame to frame, relative to the light.
    tail_dof : float
        Degrees of freedom of Student's distribution, from which robust weights come.
    n_bins : int
        So many bins are compared, half of them in the stripe: neighbours say much the same.
    max_ripple : float
        Bins resolve a stripe whose fourth difference is no larger than this, relative to its light. One that
        they do not resolve is not compared: without a gap it is off by 1.06 sigmas at 0.9, by 1.44 at 1.8.
    temperature : float
        The log evidence counts divided by this: what the error model leaves out.
    ln_odds_effect, ln_odds_further, ln_odds_unknown : float
        Prior odds against no gap: of one effect of the catalogue, of a further one, of an unknown cause.
    free_sizes : tuple of float
        1 sigma of an unknown cause's term, relative to the light that it changes; all equally probable.
    named, possible : float
        Probability from which on an effect is named, and from which on it is in an ambiguity set.
    """

    negligible: float = 0.05
    negligible_rms: float = 0.1
    image_rel: float = 0.004
    frame_rel: float = 0.003
    tail_dof: float = 6.0
    n_bins: int = 9000
    max_ripple: float = 1.0
    temperature: float = 3.0
    ln_odds_effect: float = 0.0
    ln_odds_further: float = -3.0
    ln_odds_unknown: float = -4.0
    free_sizes: tuple[float, ...] = (0.02, 0.1, 0.5)
    named: float = 0.9
    possible: float = 0.05


POLICY = Policy()
"""The policy of every posterior."""
