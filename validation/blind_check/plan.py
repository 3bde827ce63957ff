"""Which recordings a blind check is made of: effects, forms, pairs and worlds, dealt out evenly."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from validation.second_renderer.scenario import WIDE_STREAM, WIDE_TIERS, is_possible
from validation.second_renderer.world import FORMS
from validation.second_renderer.world_effect import CATALOGUE
from validation.second_renderer.world_stated import JOINTS, WIDE_JOINTS, WIDTH_PX, draw_stated, draw_wide

TIERS = "ABCDEFGHI"
"""B has no recordings of its own: it diagnoses those of `AGAIN` again, what they hide withheld."""

AGAIN = "AG"

DRY = (
    "laser_power_drift",
    "laser_speckle",
    "uneven_fan",
    "stripe_profile",
    "ambient_light",
    "plate_outline",
    "fume",
    "veiling_glare",
    "defocus",
    "vignetting",
    "dirty_window",
    "filter_shift",
    "ghost_stripe",
    "gamma",
    "black_level",
    "blooming",
    "fixed_pattern",
    "read_noise",
    "exposure_drift",
    "image_compression",
    "hand_eye",
    "surface_tilt",
    "lens_distortion",
    "pose_delay",
)
"""The effects that a run without the arc can show."""

N_WORLDS = 12
"""So many joints, metals and motions are shared by all recordings, and with them the rendered light."""

N_WIDE_WORLDS = 24
"""So many are shared by the recordings of the tiers with more joints and views."""

WIDE_STEP = 7
"""From draw to draw an effect goes on by so many of them: each has another joint, and in all it sees all."""

SEEDS = 1_000_000
"""So many seeds of recordings belong to each seed of a check."""


@dataclass(frozen=True)
class RecordingPlan:
    """A recording that is to be made: the arguments of `scenario.draw`, and a number that tells nothing."""

    number: int
    seed: int
    tier: str
    world_seed: int
    joint: str
    effects: tuple[str, ...]
    form: str | None = None
    is_dry: bool = False
    width_px: int = WIDTH_PX


def plan(
    draws: int, quiet_draws: int, tiers: str = TIERS, seed: int = 0, width_px: int = WIDTH_PX
) -> tuple[RecordingPlan, ...]:
    """Return what to make, by number, with images so wide.

    Tier A hides each effect `draws` times, C each that has another form than the catalogue's, D deals all
    effects out in pairs so often; E hides nothing in `quiet_draws` recordings. F hides each effect `draws`
    times in a plain run, and those of `DRY` as often in one without the arc. G hides each effect `draws`
    times in its further form, H deals all effects out in threes so often, I hides nothing in `quiet_draws`
    hard recordings. Equal arguments give an equal plan, whatever other tiers there are beyond F. Raises
    ValueError for a tier that there is not and for B without A or G.
    """
    for tier in tiers:
        if tier not in TIERS:
            raise ValueError(f"tier {tier!r} is not known: there are {', '.join(TIERS)}")
    if "B" in tiers and not set(AGAIN) & set(tiers):
        raise ValueError("tier B diagnoses the recordings of A or G again: name one of them too")
    shuffle = np.random.default_rng([seed, 0])
    planned = list(_contents(draws, quiet_draws, tiers, seed, shuffle))
    numbers = shuffle.permutation(len(planned)) + 1
    numbered = [
        replace(recording, number=int(n), width_px=width_px)
        for recording, n in zip(planned, numbers, strict=True)
    ]
    return tuple(sorted(numbered, key=lambda recording: recording.number))


def _contents(
    draws: int, quiet_draws: int, tiers: str, seed: int, shuffle: np.random.Generator
) -> Iterator[RecordingPlan]:
    """Yield what to make, in the order of tiers and turns."""
    counted = itertools.count()

    def planned(
        turn: int, tier: str, *effects: str, form: str | None = None, is_dry: bool = False
    ) -> RecordingPlan:
        n, (world_seed, joint) = next(counted), _world(seed, turn, effects, tier in WIDE_TIERS)
        return RecordingPlan(
            number=n,
            seed=SEEDS * seed + n,
            tier=tier,
            world_seed=world_seed,
            joint=joint,
            effects=effects,
            form=form,
            is_dry=is_dry,
        )

    ids = list(FORMS)
    for turn in range(draws):
        for n, effect in enumerate(ids):
            others = [form for form in FORMS[effect] if form != CATALOGUE]
            if "A" in tiers:
                yield planned(n + turn, "A", effect)
            if "C" in tiers and others:
                yield planned(n + turn, "C", effect, form=others[turn % len(others)])
        if "D" in tiers:
            order = shuffle.permutation(len(ids))
            for n, (i, j) in enumerate(zip(order[::2], order[1::2], strict=False)):
                yield planned(n + turn, "D", ids[i], ids[j])
    for turn in range(quiet_draws if "E" in tiers else 0):
        yield planned(turn, "E")
    for turn in range(draws if "F" in tiers else 0):
        for n, effect in enumerate(ids):
            yield planned(n + turn, "F", effect)
            if effect in DRY:
                yield planned(n + turn, "F", effect, is_dry=True)
    for turn in range(draws):
        if "G" in tiers:
            for n, effect in enumerate(ids):
                yield planned(n + WIDE_STEP * turn, "G", effect)
        if "H" in tiers:
            order = shuffle.permutation(len(ids))
            for n, triple in enumerate(zip(order[::3], order[1::3], order[2::3], strict=False)):
                yield planned(2 * n + WIDE_STEP * turn, "H", *(ids[i] for i in triple))
    for turn in range(quiet_draws if "I" in tiers else 0):
        yield planned(turn, "I")


def _world(seed: int, turn: int, effects: Sequence[str], is_wide: bool) -> tuple[int, str]:
    """Return the seed and the joint of the next world, from a turn on, in which effects can be seen."""
    joints, n_worlds = (WIDE_JOINTS, N_WIDE_WORLDS) if is_wide else (JOINTS, N_WORLDS)
    for n in range(turn, turn + n_worlds):
        world = n % n_worlds
        world_seed, joint = n_worlds * seed + world, joints[world % len(joints)]
        draw = np.random.default_rng([world_seed, WIDE_STREAM if is_wide else 0])
        stated, _ = (draw_wide if is_wide else draw_stated)(draw, joint)
        if all(is_possible(effect, stated) for effect in effects):
            return world_seed, joint
    raise AssertionError("some joints are always of the bright metal")
