"""Frames of a true world with hidden effects: what the blind check of the diagnosis is made with.

Its light transport, effects and sensor share no code with `noise_model`, only records (setup and its parts)
and rigid poses. The stages of a frame: surface, arc and stripe of the pose (`world_light`), effects on the
light, point-spread function, exposure, effects on the image, charge, shot and read noise, response.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from noise_model.compiled.arrays import Float64, Integers
from validation.second_renderer import (
    world_further_optics,
    world_further_scene,
    world_further_sensor,
    world_further_source,
    world_laser,
    world_medium,
    world_optics,
    world_scene,
    world_sensor,
    world_source,
)
from validation.second_renderer.world_effect import (
    EffectForm,
    Generator,
    HiddenEffect,
    Moment,
    WorldFrameLight,
)
from validation.second_renderer.world_light import Studio, TrueWorld
from validation.second_renderer.world_optics import point_spread
from validation.second_renderer.world_sensor import digitised, stated_response

FORMS: Mapping[str, Mapping[str, EffectForm]] = {
    effect: {form.name: form for form in forms}
    for stage in (world_scene, world_source, world_laser, world_medium, world_optics, world_sensor)
    for effect, forms in stage.FORMS.items()
}
"""All effects' forms by id and name, in the order in which they act within a frame."""

FURTHER: Mapping[str, EffectForm] = {
    effect: form
    for stage in (world_further_scene, world_further_source, world_further_optics, world_further_sensor)
    for effect, form in stage.FORMS.items()
}
"""One further form of each effect, by id: no judgement was tuned on it."""


def form_of(hidden: HiddenEffect) -> EffectForm:
    """Return a hidden effect's form. Raises ValueError for an id or a form that there is not."""
    if hidden.id not in FORMS:
        raise ValueError(f"effect {hidden.id!r} is not known: there are {', '.join(FORMS)}")
    forms = {**FORMS[hidden.id], FURTHER[hidden.id].name: FURTHER[hidden.id]}
    if hidden.form not in forms:
        raise ValueError(f"{hidden.id} has no form {hidden.form!r}: it has {', '.join(forms)}")
    return forms[hidden.form]


def in_order(effects: Sequence[HiddenEffect]) -> list[tuple[EffectForm, HiddenEffect]]:
    """Return effects with their forms in the order in which they act."""
    formed = [(form_of(hidden), hidden) for hidden in effects]
    return sorted(formed, key=lambda pair: list(FORMS).index(pair[1].id))


def apply_world_effects(world: TrueWorld, effects: Sequence[HiddenEffect]) -> TrueWorld:
    """Return a world with the effects that change what is rendered."""
    for form, hidden in in_order(effects):
        if form.world is not None:
            world = form.world(world, hidden.values)
    return world


def apply_moment_effects(moment: Moment, effects: Sequence[HiddenEffect]) -> Moment:
    """Return a frame's moment with the effects that change levels, exposure, arc or pose."""
    for form, hidden in in_order(effects):
        if form.moment is not None:
            moment = form.moment(moment, hidden.values)
    return moment


def expected_charge(
    studio: Studio, effects: Sequence[HiddenEffect], moment: Moment, T_base_tool: Float64, draw: Generator
) -> Float64:
    """Return the charge (H, W), e-, that light makes on average in a frame's exposure.

    `studio.world` and `moment` are what is really there; `draw` is for effects that differ from frame to
    frame, speckle and spatter.
    """
    camera, acting = studio.world.setup.camera, in_order(effects)
    if moment.arc_level == moment.laser_level == 0.0 and not any(form.in_dark for form, _ in acting):
        return np.zeros((camera.height, camera.width))
    sight = studio.sight(T_base_tool, moment.camera_turn_deg, moment.camera_move_mm)
    body = studio.arc_body(sight, moment.arc_shift_mm)
    dark = np.zeros(sight.shape)
    frame = WorldFrameLight(
        studio,
        sight,
        body,
        moment,
        draw,
        arc=moment.arc_level * studio.arc_light(sight, body) if moment.arc_level > 0.0 else dark,
        laser=moment.laser_level * studio.stripe(sight) if moment.laser_level > 0.0 else dark,
        other=dark,
    )
    for form, hidden in acting:
        if form.light is not None:
            form.light(frame, hidden.values)
    frame.through(lambda image: point_spread(image, camera.psf_sigma_px) if image.any() else image)
    frame.scale(moment.exposure_s / camera.exposure_s)
    for form, hidden in acting:
        if form.image is not None:
            form.image(frame, hidden.values)
    charge = frame.total
    for form, hidden in acting:
        if form.charge is not None:
            charge = form.charge(charge, studio.world, hidden.values)
    return charge


def read_out(
    world: TrueWorld, effects: Sequence[HiddenEffect], moment: Moment, charge_e: Float64, draw: Generator
) -> Integers:
    """Return a frame (H, W), DN, of an expected charge: shot noise, read noise, full well, response."""
    sensor, shape = world.setup.sensor, (charge_e.shape[0], charge_e.shape[1])
    noise = sensor.read_noise_e * draw.standard_normal(shape)
    black_dn = np.full(shape, sensor.black_level_dn)
    acting = in_order(effects)
    for form, hidden in acting:
        if form.noise is not None:
            noise = form.noise(draw, shape, sensor.read_noise_e, hidden.values)
        if form.offset is not None:
            black_dn = black_dn + form.offset(moment, shape, hidden.values)
    charge = np.minimum(draw.poisson(np.maximum(charge_e, 0.0)) + noise, sensor.full_well_e)
    over_black = stated_response(charge, sensor)
    for form, hidden in acting:
        if form.response is not None:
            over_black = form.response(charge, world, hidden.values)
    codes = digitised(over_black, black_dn, sensor)
    for form, hidden in acting:
        if form.codes is not None:
            codes = form.codes(codes, hidden.values)
    return codes
