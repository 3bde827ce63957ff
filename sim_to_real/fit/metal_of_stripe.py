"""The metal that no setup states, as the laser's stripe shows it."""

from collections.abc import Callable
from dataclasses import replace

from noise_model.effects import REGISTRY
from noise_model.setup import Setup
from noise_model.surface.brdf import TABLE_1, Material
from sim_to_real.data.binned import ObservedRecording
from sim_to_real.fit.gauss_newton import refit
from sim_to_real.fit.linearized_model import LinearizedModel


def metal_of_stripe(observed: ObservedRecording, threads: int) -> Callable[[Setup], Setup]:
    """Return the change of a setup that states the metal which a recording's stripe shows.

    The best fitting metal of the paper's Table 1 is the start; its kappas and c2 are fitted with the
    nuisances. The stripe's brightness stays the laser's `peak_e`: kappas set only its dependence on the
    angles.
    """
    fits = []
    for material in TABLE_1.values():
        model = LinearizedModel(observed.of_metal(_with_material(material)), threads)
        model = model.anchored_at(model.neutral, {})
        fits.append((refit(model, {}, model.neutral), model, material))
    start, model, material = min(fits, key=lambda fit: fit[0].mean_square)
    # Their parameters are a metal's kappas and c2.
    names = ("wrong_material", "roughness_change")
    fitted = refit(model, {name: REGISTRY[name].neutral for name in names}, start.nuisance)

    def change(setup: Setup) -> Setup:
        setup = _with_material(material)(setup)
        for name in names:
            apply = REGISTRY[name].setup
            assert apply is not None
            setup = apply(setup, fitted.effects[name])
        return replace(setup, material=replace(setup.material, name="as the stripe shows it"))

    return change


def _with_material(material: Material) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, material=material)
