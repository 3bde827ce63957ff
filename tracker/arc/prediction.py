"""The arc's light that a pose lets expect."""

from __future__ import annotations

from typing import NamedTuple

from noise_model.arc.fill import fill_band, fill_pixels
from noise_model.arc.map import NODES_P, NODES_Q, Horizon, kernel_of, table_of
from noise_model.arc.quadrature import DiscRule
from noise_model.arc.scene import Scene
from noise_model.arc.scratch import ArcScratch
from noise_model.compiled.arrays import Float32, Int64
from noise_model.compiled.kernel import kernel
from noise_model.surface.brdf import LobeNumbers
from tracker.geometry import MAP_FLOOR_E, MAP_TOLERANCE, ArcSource, ImageSource


class ArcLightBuffers(NamedTuple):
    """Pixels (n,) and band (n_scan, depth) where the arc's light is wanted, and room for it, e-.

    `pixels` are counted by scan line. For each CELL scan lines the band begins at a place of `lows`.
    """

    pixels: Int64
    pixel_e: Float32
    lows: Int64
    band_e: Float32
    work: ArcScratch


@kernel(allocates=True)
def predict_arc(
    arc: ArcSource,
    image: ImageSource,
    material: LobeNumbers,
    scene: Scene,
    horizon: Horizon,
    output: float,
    into: ArcLightBuffers,
) -> None:
    """Write the arc's light of a scene, for so many times its stated output; NaN past the workpiece."""
    rule = DiscRule(arc.rules, NODES_P, NODES_Q)
    k = kernel_of(scene, horizon, arc.radius_mm, arc.radiance_e * output, material, rule)
    table = table_of(k, image.xy, image.n_scan, MAP_TOLERANCE, MAP_FLOOR_E, arc.to_powers, arc.baked)
    fill_pixels(k, table, image.xy, image.cos4, into.pixels, into.pixel_e, into.work)
    if into.band_e.shape[1] > 0:
        fill_band(
            k=k,
            table=table,
            xy=image.xy,
            cos4=image.cos4,
            rules=(arc.node_at, arc.node_rules),
            lows=into.lows,
            band_e=into.band_e,
            work=into.work,
        )
