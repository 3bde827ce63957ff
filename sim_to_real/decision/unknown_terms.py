"""Terms of an unknown cause, one by one: what each depends on, how probable it is, how much it explains."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from noise_model.effects.effect import Stage
from sim_to_real.diagnosis import UnknownTerm
from sim_to_real.evidence.coordinates import IN_EACH_FRAME
from sim_to_real.evidence.error_model import ErrorModel, LinearHypothesis
from sim_to_real.evidence.free_functions import MIN_EXCESS
from sim_to_real.evidence.policy import Policy


class TermTraits(NamedTuple):
    """Coordinate kind of a free term, the source of its light, and both in `words`."""

    coordinate: str
    source: str
    words: str


TRAITS: Mapping[str, TermTraits] = {
    IN_EACH_FRAME: TermTraits("time", "arc", "arc light that changes from frame to frame"),
    "arc over the field": TermTraits("image", "arc", "arc light that depends on the distance from the axis"),
    "arc over the angle of incidence": TermTraits("angle", "arc", "arc light that depends on its incidence"),
    "arc over the azimuth": TermTraits("angle", "arc", "arc light that depends on the side it comes from"),
    "laser in each frame": TermTraits("time", "laser", "laser light that changes from frame to frame"),
    "laser along columns": TermTraits("image", "laser", "laser light that depends on the image's column"),
    "laser along rows": TermTraits("image", "laser", "laser light that depends on the image's row"),
    "laser across its sheet": TermTraits("sheet", "laser", "another profile or place of the laser's sheet"),
    "light over the part": TermTraits("part", "laser and arc", "light that depends on the place on the part"),
    "arc over the half angle": TermTraits("angle", "arc", "arc light off the mirror direction"),
    "arc over the angle of view": TermTraits("angle", "arc", "arc light that depends on the viewing angle"),
    "laser over the angle of view": TermTraits("angle", "laser", "laser light by the viewing angle"),
    "arc between faces": TermTraits("part", "arc", "arc light between the joint's faces"),
    "arc over the distance": TermTraits("distance", "arc", "arc light that depends on the distance from it"),
    "light over time": TermTraits("time", "laser and arc", "light that changes slowly over time"),
    "light about the arc, with its current": TermTraits(
        "distance", "arc", "light added about the arc, as its current"
    ),
    "light about the arc": TermTraits("distance", "arc", "light added about the arc, whatever its current"),
    "light over the image": TermTraits("image", "laser and arc", "light that depends on the image's place"),
    "light over the radius": TermTraits("image", "laser and arc", "light by the distance from the axis"),
    "light beside the stripe": TermTraits("sheet", "laser", "light added beside the stripe"),
    "mean light over the image": TermTraits("image", "laser and arc", "stray light over the image"),
    "grey level": TermTraits("grey level", "any light", "another response of the sensor to light"),
    "light in each frame": TermTraits("time", "laser and arc", "light that changes from frame to frame"),
    "rows": TermTraits("image", "none", "an offset over the image's rows"),
    "light of the hall over the part": TermTraits("hall", "hall", "light of the hall on the scene"),
    "offset in each frame": TermTraits("time", "none", "an offset that changes from frame to frame"),
    "pose of the camera, distortion": TermTraits(
        "pose", "any light", "an image that is displaced throughout"
    ),
    "turn in each frame": TermTraits("time", "any light", "an image that turns from frame to frame"),
    "shift in each frame": TermTraits("time", "any light", "an image that shifts from frame to frame"),
}
"""Traits of the free terms of `coordinates.free_terms`, by name."""


def likely_terms(hypothesis: LinearHypothesis, errors: ErrorModel, policy: Policy) -> tuple[UnknownTerm, ...]:
    """Return the terms that may be added to a hypothesis, one alone each, the likeliest first.

    Terms that stand for several at once are left out: they say less of what to look at.
    """
    table = errors.table(hypothesis, errors.free_blocks)
    alone = table.sizes()
    weighed: list[tuple[Stage, str, float, float, float]] = []
    for term in errors.free_terms.terms:
        if term.stage is None or len(term.blocks) > 1:
            continue
        sizes = [(table.sizes(*term.blocks, size=size), size) for size in policy.free_sizes]
        best, size = max(sizes, key=lambda pair: pair[0].nats)
        nats = float(logsumexp([of_size.nats - alone.nats for of_size, _ in sizes]) - math.log(len(sizes)))
        weighed.append((term.stage, term.name, nats, size, best.mean_square))
    floor = min([1.0, *(mean_square for *_, mean_square in weighed)])
    excess = max(alone.mean_square - floor, MIN_EXCESS * floor)
    ln = np.array([nats for _, _, nats, _, _ in weighed]) / policy.temperature
    probabilities = np.exp(ln - logsumexp(ln)).tolist()
    terms = [
        UnknownTerm(
            stage=stage.value,
            name=name,
            coordinate=TRAITS[name].coordinate,
            source=TRAITS[name].source,
            words=TRAITS[name].words,
            nats=nats,
            size=size,
            probability=probability,
            share=float(np.clip((alone.mean_square - mean_square) / excess, 0.0, 1.0)),
        )
        for (stage, name, nats, size, mean_square), probability in zip(weighed, probabilities, strict=True)
    ]
    return tuple(sorted(terms, key=lambda term: -term.nats))


def rival_terms(terms: tuple[UnknownTerm, ...], count: int = 3) -> tuple[UnknownTerm, ...]:
    """Return the likeliest term of each of the likeliest kinds of coordinates, at most `count`."""
    by_kind = {term.coordinate: term for term in reversed(terms)}
    return tuple(sorted(by_kind.values(), key=lambda term: -term.nats)[:count])
