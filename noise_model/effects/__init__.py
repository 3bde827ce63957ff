"""The effects that the nominal model leaves out: one file a stage, this one registry.

They act in the order light takes: source, illumination, surface, medium, optics, sensor; geometry and timing
change what is rendered. `noise_model.forward` applies them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace

from noise_model.condition import Condition
from noise_model.effects import geometry, illumination, medium, optics, sensor, source, surface, timing
from noise_model.effects.effect import Effect, Effects, Stage, Values
from noise_model.setup import Setup
from noise_model.spelling import cure_for
from noise_model.surface.joint import Joint

__all__ = [
    "REGISTRY",
    "Effect",
    "Effects",
    "Stage",
    "Values",
    "acting",
    "apply_condition_effects",
    "apply_setup_effects",
    "checked",
    "not_predicted",
    "pose_time_s",
]

REGISTRY: Mapping[str, Effect] = {
    effect.id: effect
    for stage in (source, illumination, surface, medium, optics, sensor, geometry, timing)
    for effect in stage.EFFECTS
}
"""All effects by id, in the order in which they act within one frame."""


def checked(
    effects: Mapping[str, Values], joint: Joint | None = None, missing: Collection[str] = ()
) -> dict[str, dict[str, float]]:
    """Return effects with all their parameters, in the registry's order.

    Raises ValueError for an unknown id, an unknown parameter or a value out of its bounds, and for an effect
    that is not predicted for a joint, where one is given, or that needs a section of a setup that is missing.
    """
    for name in effects:
        if name not in REGISTRY:
            raise ValueError(f"[effects.{name}]: there is no such effect; {cure_for(name, REGISTRY)}")
        if joint is not None and not REGISTRY[name].is_followed(joint):
            raise ValueError(f"[effects.{name}]: is not predicted for a {joint.type}; leave it out")
        needed = [section for section in REGISTRY[name].needs if section in missing]
        if needed:
            raise ValueError(f"[effects.{name}]: needs [{needed[0]}], which is missing; state it")
    return {name: effect.complete(effects[name]) for name, effect in REGISTRY.items() if name in effects}


def not_predicted(setup: Setup) -> tuple[str, ...]:
    """Return the effects that nothing can be predicted of: for the joint, or without a missing section."""
    missing = set(setup.missing)
    return tuple(
        name
        for name, effect in REGISTRY.items()
        if not effect.is_followed(setup.joint) or missing & set(effect.needs)
    )


def acting(setup: Setup) -> Iterator[tuple[Effect, dict[str, float]]]:
    """Yield the effects of a setup and their parameters, in the registry's order."""
    for name, values in checked(setup.effects).items():
        yield REGISTRY[name], values


def apply_setup_effects(setup: Setup) -> Setup:
    """Return the setup that is really there: the effects that change it are applied and listed no more.

    Those that act on levels, light, image or the poses' clock stay listed.
    """
    true = setup
    for effect, values in acting(setup):
        if effect.setup is not None:
            true = effect.setup(true, values)
    return replace(true, effects={e.id: values for e, values in acting(setup) if e.setup is None})


def apply_condition_effects(setup: Setup, condition: Condition) -> Condition:
    """Return the levels and the exposure that a frame of this stated condition really has."""
    for effect, values in acting(setup):
        if effect.condition is not None:
            condition = effect.condition(condition, values)
    return condition


def pose_time_s(setup: Setup, timestamp_s: float) -> float:
    """Return the time that the controller stamped on the pose of a frame.

    Parameters
    ----------
    setup : Setup
        Its effect `pose_delay`, if it has it, says how late the stamp is.
    timestamp_s : float
        The frame's time, s.

    Returns
    -------
    float
        The pose's time, s.
    """
    return timestamp_s + setup.effects.get("pose_delay", {}).get("delay_s", 0.0)
