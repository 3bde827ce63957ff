"""The coordinates in which each stage acts, as bases of smooth functions.

The error of a stage is a smooth function of its own coordinates: a sensor's of the grey level, a lens' of the
place in the image, a metal's of the angles, a source's of time and direction. Multiplied by the light, the
bases span an unknown cause at that stage. Multiplied by an effect's change, they span the errors of its form.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float32, Float64
from noise_model.effects.effect import Stage
from sim_to_real.fit.covariates import Covariates

IN_EACH_FRAME = "arc in each frame"
"""The free term that stands for an arc that flickers."""

TOGETHER, ANYTHING = "all of these", "anything"
"""The free terms of all of a stage's bases, and of all bases."""

ADDED_DN = 50.0
"""Amplitude of a free term of size 1 that adds to the image."""


@dataclass(frozen=True)
class FreeTerm:
    """An unknown cause at a stage: any smooth function of some coordinates.

    `blocks` are the numbers of its blocks of columns, see `FreeTerms`. A term of no stage has all of them.
    """

    stage: Stage | None
    name: str
    blocks: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class FreeTerms:
    """All terms of an unknown cause, and the `columns` (n, k) of the blocks that they are made of."""

    terms: tuple[FreeTerm, ...]
    columns: tuple[Float32, ...]

    def columns_of(self, stage: Stage, name: str) -> Float32:
        """Return the columns (n, k) of a term that there is."""
        blocks = next(term.blocks for term in self.terms if (term.stage, term.name) == (stage, name))
        return np.hstack([self.columns[n] for n in blocks])


@dataclass(frozen=True, eq=False)
class _Basis:
    stage: Stage
    name: str
    functions: Float32
    light: Float32


class _FreeColumns(NamedTuple):
    stage: Stage
    name: str
    columns: Float32


def free_terms(covariates: Covariates) -> FreeTerms:
    """Return the terms of an unknown cause: bases and displacements, each stage's together, and all of them.

    Terms that change nothing, as of an arc that is off, are left out.
    """
    every = [
        _FreeColumns(basis.stage, basis.name, basis.functions * basis.light[:, np.newaxis])
        for basis in _bases(covariates)
    ]
    every = [
        free for free in (*every, *_additions(covariates), *_displacements(covariates)) if free.columns.any()
    ]
    terms = [FreeTerm(free.stage, free.name, (n,)) for n, free in enumerate(every)]
    for stage in dict.fromkeys(free.stage for free in every):
        together = tuple(n for n, free in enumerate(every) if free.stage is stage)
        if len(together) > 1:
            terms.append(FreeTerm(stage, TOGETHER, together))
    terms.append(FreeTerm(None, ANYTHING, tuple(range(len(every)))))
    return FreeTerms(tuple(terms), tuple(free.columns for free in every))


def form_functions(covariates: Covariates) -> Mapping[Stage, tuple[Float32, ...]]:
    """Return the errors (n, k) that the form of a stage's effects may have, in each of its coordinates.

    The last ones are of all coordinates together. For sizes of unit variance, each sum has about unit
    variance in each bin.
    """
    everywhere = np.ones((len(covariates.frame), 1), dtype=np.float32)
    bases = _bases(covariates)
    forms: dict[Stage, tuple[Float32, ...]] = {}
    for stage in Stage:
        # Some bases differ by the light alone.
        parts = list({id(b.functions): b.functions for b in bases if b.stage is stage}.values())
        chosen = [[everywhere, part] for part in parts]
        if len(parts) != 1:
            chosen.append([everywhere, *parts])
        forms[stage] = tuple(
            np.asarray(np.hstack(some) / math.sqrt(len(some)), dtype=np.float32) for some in chosen
        )
    return forms


def texture(covariates: Covariates) -> Float32:
    """Return smooth functions (n, k) of the place on the part: how the scene's brightness may vary."""
    along_mm, aside_mm = covariates.part_mm.T
    return hats_2d(along_mm, aside_mm, 9, 6)


def _bases(covariates: Covariates) -> list[_Basis]:
    values, per_dn = covariates.values, 1.0 / covariates.sigma_dn
    arc, laser = covariates.arc_dn * per_dn, covariates.laser_dn * per_dn
    light, added = arc + laser, ADDED_DN * per_dn
    in_frame = frame_indicators(covariates)
    rho2 = (values["radius"] / max(float(np.max(values["radius"], initial=0.0)), 1e-9)) ** 2
    radial = np.column_stack([np.ones_like(rho2), rho2, rho2**2]).astype(np.float32)
    exposed = values["exposure"] / max(float(np.max(values["exposure"], initial=0.0)), 1e-9)
    current = values["current"] / max(float(np.max(values["current"], initial=0.0)), 1e-9)
    lit = np.where(values["current"] > 0.0, exposed, 0.0) * added
    mean_light = _mean_in_frame(covariates, covariates.light_dn) * per_dn
    image, distance = hats_2d(values["row"], values["column"], 5, 6), hats(values["distance"], 6)
    off_sheet_mm = values["beside_sheet"]
    profile = hats(np.where(covariates.in_stripe, off_sheet_mm, np.float32(np.nan)), 11)
    laser_on = _mean_in_frame(covariates, covariates.laser_dn) > 0.0

    def along(name: str, count: int) -> Float32:
        return hats(values[name], count)

    return [
        _Basis(Stage.SOURCE, IN_EACH_FRAME, in_frame, arc),
        _Basis(Stage.SOURCE, "arc over the field", radial, arc),
        _Basis(Stage.SOURCE, "arc over the angle of incidence", along("theta_i", 5), arc),
        _Basis(Stage.SOURCE, "arc over the azimuth", along("phi_r", 5), arc),
        _Basis(Stage.ILLUMINATION, "laser in each frame", in_frame, laser),
        _Basis(Stage.ILLUMINATION, "laser along columns", along("column", 9), laser),
        _Basis(Stage.ILLUMINATION, "laser along rows", along("row", 5), laser),
        _Basis(Stage.ILLUMINATION, "laser across its sheet", profile, laser),
        _Basis(Stage.SURFACE, "light over the part", texture(covariates), light),
        _Basis(Stage.SURFACE, "arc over the half angle", along("half_angle", 9), arc),
        _Basis(Stage.SURFACE, "arc over the angle of incidence", along("theta_i", 5), arc),
        _Basis(Stage.SURFACE, "arc over the angle of view", along("theta_r", 5), arc),
        _Basis(Stage.SURFACE, "arc over the azimuth", along("phi_r", 5), arc),
        _Basis(Stage.SURFACE, "laser over the angle of view", along("theta_r", 4), laser),
        _Basis(Stage.SURFACE, "arc between faces", along("concavity", 4), current * lit),
        _Basis(Stage.MEDIUM, "arc over the distance", distance, arc),
        _Basis(Stage.MEDIUM, "light over time", along("time", 4), light),
        _Basis(Stage.MEDIUM, "light about the arc, with its current", distance, current * lit),
        _Basis(Stage.MEDIUM, "light about the arc", distance, lit),
        _Basis(Stage.OPTICS, "light over the image", image, light),
        _Basis(Stage.OPTICS, "light over the radius", radial, light),
        # A ghost stripe is as narrow as the stripe: there is a knot for each place that it may have.
        _Basis(Stage.OPTICS, "light beside the stripe", even_hats(off_sheet_mm, 49), laser_on * added),
        _Basis(Stage.OPTICS, "mean light over the image", image, mean_light),
        _Basis(Stage.SENSOR, "grey level", along("gray_level", 9), added),
        _Basis(Stage.SENSOR, "light in each frame", in_frame, light),
        _Basis(Stage.SENSOR, "rows", along("row", 5), added),
    ]


def _additions(covariates: Covariates) -> list[_FreeColumns]:
    """Return the terms that neither laser nor arc changes: a scene lit by the hall, an offset."""
    exposed, always = covariates.values["exposure"], np.ones_like(covariates.sigma_dn)
    return [
        _FreeColumns(
            stage, name, np.asarray(functions * _added_light(covariates, size)[:, np.newaxis], np.float32)
        )
        for stage, name, functions, size in (
            (Stage.ILLUMINATION, "light of the hall over the part", texture(covariates), exposed),
            (Stage.SENSOR, "offset in each frame", frame_indicators(covariates), always),
        )
    ]


def _added_light(covariates: Covariates, size: Float32) -> Float32:
    """Return the light (n,) of an added term of size 1, proportional to `size` (n,), over the bins' noise."""
    largest = max(float(np.max(size, initial=0.0)), 1e-9)
    return np.asarray(ADDED_DN * size / largest / covariates.sigma_dn, dtype=np.float32)


def _displacements(covariates: Covariates) -> list[_FreeColumns]:
    """Return displacements by the camera's pose and distortion, and in each frame, as of a wrong clock."""
    pose = covariates.by_camera
    values = covariates.values
    reach = max(float(np.max(np.abs(values["column"]), initial=1.0)), 1.0)
    x = (values["column"] - np.mean(values["column"])) / reach
    y = (values["row"] - np.mean(values["row"])) / reach
    # A camera turned about x and y sees the image shifted down and along its rows.
    outward = pose[:, 1] * x - pose[:, 0] * y
    distortion = np.column_stack([outward, 4.0 * outward * (x**2 + y**2)])
    # Rotation and translation of the camera by a free term of size 1.
    sizes = np.array([2.0] * 3 + [2.5] * 3, dtype=np.float32)
    in_frame = frame_indicators(covariates)
    # A free term of size 1 turns the camera by 0.3 deg and moves it by 0.3 mm, as a wrong clock does.
    turned = pairwise_products(in_frame, np.float32(0.3) * pose[:, :3])
    shifted = pairwise_products(in_frame, np.float32(0.3) * pose[:, 3:])
    return [
        _FreeColumns(
            Stage.GEOMETRY,
            "pose of the camera, distortion",
            np.hstack([pose * sizes, distortion]).astype(np.float32),
        ),
        _FreeColumns(Stage.TIMING, "turn in each frame", turned),
        _FreeColumns(Stage.TIMING, "shift in each frame", shifted),
    ]


def _mean_in_frame(covariates: Covariates, light_dn: Float32) -> Float32:
    """Return the mean of light (n,), DN, over each bin's frame."""
    total, count = np.bincount(covariates.frame, light_dn), np.bincount(covariates.frame)
    return np.asarray((total / np.maximum(count, 1))[covariates.frame], dtype=np.float32)


def hats(values: Float32, count: int) -> Float32:
    """Return at most `count` hat functions (n, k) of values (n,), at their quantiles, or at each of a few
    values.

    Each falls from 1 at its knot to 0 at the next ones. NaN belongs to no hat.
    """
    known = np.isfinite(values)
    places = np.unique(values[known])
    if len(places) > count:
        places = np.unique(np.quantile(values[known], np.linspace(0.0, 1.0, count)))
    return _hats_at(values, known, places)


def even_hats(values: Float32, count: int) -> Float32:
    """Return `count` hat functions (n, k) of values (n,), with equidistant knots."""
    known = np.isfinite(values)
    low, high = np.min(values[known], initial=np.inf), np.max(values[known], initial=-np.inf)
    return _hats_at(values, known, np.linspace(low, high, count) if low < high else np.zeros(0))


def _hats_at(values: Float32, known: Bool, places: Float64 | Float32) -> Float32:
    """Return hat functions (n, k) of those values (n,) that are known, with knots at some places (k,)."""
    if len(places) < 2:
        return np.asarray(known, dtype=np.float32)[:, np.newaxis]
    X = np.zeros((len(values), len(places)), dtype=np.float32)
    lower = np.clip(np.searchsorted(places, values[known], side="right") - 1, 0, len(places) - 2)
    share = np.clip((values[known] - places[lower]) / np.diff(places)[lower], 0.0, 1.0)
    rows = np.flatnonzero(known)
    X[rows, lower], X[rows, lower + 1] = 1.0 - share, share
    return X


def hats_2d(rows: Float32, columns: Float32, n_rows: int, n_columns: int) -> Float32:
    """Return products of hats of row and column (n, k): piecewise bilinear functions over the image."""
    return pairwise_products(hats(rows, n_rows), hats(columns, n_columns))


def pairwise_products(first: Float32, second: Float32) -> Float32:
    """Return the products (n, k j) of each of some functions (n, k) with each of others (n, j)."""
    product = first[:, :, np.newaxis] * second[:, np.newaxis, :]
    return np.asarray(product.reshape(len(product), -1))


def frame_indicators(covariates: Covariates) -> Float32:
    """Return for each frame (n, n_frames) whether a bin is in it."""
    return np.asarray(covariates.frame[:, np.newaxis] == np.unique(covariates.frame), dtype=np.float32)
