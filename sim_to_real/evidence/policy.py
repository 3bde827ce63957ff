"""The constants of the judgement, in one record: what the model's own error is like, and the prior odds."""

from dataclasses import dataclass

import numpy as np

from noise_model.compiled.arrays import Float64


@dataclass(frozen=True)
class CausePolicy:
    """Logistic regression for the probability that a leading effect is there and mimics nothing unknown.

    Its log odds are `ln_odds`, and more for each nat by which the same effects with an unknown cause beside
    them are likelier (`per_nat_added`), for each nat by which an unknown cause alone is (`per_nat_alone`),
    and for the share of the gap in the bins that stays open (`per_open_share`). Nats count within
    `added_nats` and `alone_nats`. The weights are fitted to one half of the diagnoses of opened checks, whose
    leading effect is right in four of five, and judged on the other: `benchmarks/confidence.py`.
    """

    ln_odds: float = 1.80
    per_nat_added: float = -0.094
    per_nat_alone: float = -0.0074
    per_open_share: float = -2.71
    added_nats: tuple[float, float] = (-10.0, 30.0)
    alone_nats: tuple[float, float] = (-200.0, 50.0)

    @property
    def weights(self) -> Float64:
        """The weights (4,) of the features, that of the constant first."""
        return np.array([self.ln_odds, self.per_nat_added, self.per_nat_alone, self.per_open_share])


@dataclass(frozen=True)
class NeedPolicy:
    """Logistic regression for the probability that each of two effects that lead is there, if the other is.

    Its log odds are `ln_odds`, more for ln of the nats by which both are likelier than the other alone
    (`per_ln_nat`), and less for each nat by which an unknown cause beside both is likelier (`per_nat_added`):
    the second of two may stand for what the form of the first lacks. Nats count within `added_nats`. The
    weights are fitted and judged as those of `CausePolicy` are.
    """

    ln_odds: float = -5.43
    per_ln_nat: float = 1.42
    per_nat_added: float = -0.164
    added_nats: tuple[float, float] = (-10.0, 30.0)

    @property
    def weights(self) -> Float64:
        """The weights (3,) of the features, that of the constant first."""
        return np.array([self.ln_odds, self.per_ln_nat, self.per_nat_added])


@dataclass(frozen=True)
class Policy:
    """Assumptions of the comparison of hypotheses.

    The number of verdicts that flip where a constant is 20 % smaller or larger is measured on opened blind
    checks: docs/research/blind_check.md, `benchmarks/policy_sensitivity.py`.

    - `negligible`: 1 sigma of every effect's error in a recording without a gap, in sigmas of its prior.
      Chosen, with the next three, so that quiet recordings of an independent renderer have no gap.
    - `negligible_rms`: largest RMS of that over all bins, in sigmas of the bins' noise.
    - `image_rel`, `frame_rel`: 1 sigma of the model's own smooth error over the image and from frame to
      frame, as a share of the light. Against a path tracer the model's blocks are off by up to 0.8 %:
      docs/research/path_tracer.md.
    - `face_rel`: 1 sigma of what a face of the joint reflects, as a share of its light. A groove's walls are
      cut and its plates rolled: a metal's stated reflectance is not that of each.
    - `tail_dof`: degrees of freedom of Student's distribution, from which robust weights come. Chosen between
      few, which give outliers little weight, and a normal distribution (Lange, Little and Taylor 1989, J. Am.
      Stat. Assoc. 84, 881).
    - `n_bins`: number of bins compared, half of them in the stripe. Neighbours are nearly redundant, and the
      time grows with the number.
    - `max_ripple`: largest fourth difference of a stripe that bins resolve, as a share of its light. One that
      they do not resolve is off without a gap by 1.06 sigmas at 0.9, by 1.44 at 1.8.
    - `temperature`: divisor of the log evidence, for what the error model leaves out. Chosen; at 2 to 4.5 as
      many verdicts on an opened check are right.
    - `ln_odds_effect`, `ln_odds_further`, `ln_odds_unknown`: prior odds against no gap, nats, of one effect
      of the catalogue, a further cause, an unknown one. An effect of the catalogue is a third as probable as
      no gap, a second cause in addition a twentieth of that, and one that the catalogue lacks a fiftieth as
      probable as no gap; on opened checks the first names nothing in 148 quiet recordings, and 0 names a
      blooming of 0.52 in one.
    - `free_sizes`: 1 sigma of an unknown cause's term, all equally probable, as shares of the light that it
      changes. Chosen, from the model's possible error to half of the light.
    - `named`, `possible`: least probability of an effect that is named, and of one in an ambiguity set.
      Chosen: of names given at 0.9 one in ten is wrong.
    - `indistinguishable`: largest share of the bins' gap by which an effect closes less than the one that
      leads and still leaves the same pictures. On opened checks none of 177 right names has such a rival, and
      4 of 33 names for a withheld cause; at 0.01 and 0.1 none and 2, 3 and 5.
    - `explained`: least share of the gap of held-out frames that named effects close; where they close less,
      something unknown acts beside them. On an opened check that holds for 17 of 32 wrong names of a withheld
      cause, and for 3 of 162 right ones.
    - `cause`: how probable it is that what leads mimics nothing unknown.
    - `need`: how probable it is that each of two effects that lead is there.
    """

    negligible: float = 0.05
    negligible_rms: float = 0.1
    image_rel: float = 0.004
    frame_rel: float = 0.003
    face_rel: float = 0.01
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
    indistinguishable: float = 0.03
    explained: float = 0.9
    cause: CausePolicy = CausePolicy()
    need: NeedPolicy = NeedPolicy()


POLICY = Policy()
"""The policy of every posterior."""
