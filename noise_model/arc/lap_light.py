"""The arc's light on a point of a lap whose edge is no straight line: the integral over upright slices.

A direction is a slice's azimuth phi and t, the sine of its elevation: d(omega) = dt d(phi), d(phi) = dd / D
for slices at offsets d (`slices`). The offsets are Chebyshev's nodes, a lane each, with Fejer's weights; in t
there are Gauss-Legendre's nodes. Where a border turns between two slices the rule loses its high order, so
there are four slices where the disc has one node.
"""

from __future__ import annotations

import math

from noise_model.arc.quadrature import EXP_LIMIT, MAX_NODES_Q, DiscRule, Patch, more_nodes
from noise_model.arc.slices import (
    AZIMUTH_X,
    AZIMUTH_Y,
    HIGH,
    LOW,
    MAX_SLICES,
    NEAR_HIGH,
    NEAR_LOW,
    WEIGHT,
    SlicedSheets,
    lay,
    open_ends,
    open_range,
    parting_offset,
    upright_range,
)
from noise_model.compiled.arrays import Float32, Float64, Point
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.compiled.lanes import N_LANES, greater, lesser, load, root, spread, total
from noise_model.surface.brdf import LobeNumbers, reflected

MAX_LOOKS = 3
"""Number of times that slices are laid into the open part of the arc."""

SHUT_ENDS = 2
"""Largest number of shut slices at either end, where they lie close, that are not laid anew."""


@kernel(inline=True)
def _sum_round(
    patch: Patch, material: LobeNumbers, rule: DiscRule, low: int, high: int, room: Float32
) -> float:
    """Return the sum of f_r cos(theta_i) dt d(phi) over slices, for a round Gaussian lobe.

    Each goes between the sines that begin at `low` and `high` in the room. See `quadrature._sum_round`.
    """
    _, normal, omega_r = patch
    rules, n, n_q = rule
    zero, unity = spread(0.0), spread(1.0)
    cos_r = normal[0] * omega_r[0] + normal[1] * omega_r[1] + normal[2] * omega_r[2]
    light = zero
    for first in range(0, n, N_LANES):
        begin = load(room, low + first)
        length = greater(load(room, high + first) - begin, zero)
        x, y = load(room, AZIMUTH_X + first), load(room, AZIMUTH_Y + first)
        n_h = spread(normal[0]) * x + spread(normal[1]) * y
        r_h = spread(omega_r[0]) * x + spread(omega_r[1]) * y
        scale = load(room, WEIGHT + first) * length
        part = zero
        for j in range(n_q):
            t = begin + length * spread(rules[2, n_q, j])
            level = root(greater(unity - t * t, zero))
            cos_i = greater(level * n_h + t * spread(normal[2]), zero)
            towards = level * r_h + t * spread(omega_r[2])
            inverse_h = unity / root(spread(2.0) + spread(2.0) * towards)
            cos_alpha = lesser((cos_i + spread(cos_r)) * inverse_h, unity)
            v = unity - cos_alpha
            alpha_2 = spread(4.0 / 2079.0) + v * (spread(16.0 / 21021.0) + v * spread(2.0 / 6435.0))
            alpha_2 = spread(1.0 / 70.0) + v * (spread(8.0 / 1575.0) + v * alpha_2)
            alpha_2 = unity + v * (spread(1.0 / 6.0) + v * (spread(2.0 / 45.0) + v * alpha_2))
            power = lesser(spread(2.0 * material[2]) * v * alpha_2, spread(EXP_LIMIT)) * spread(-1.0 / 64.0)
            fall = spread(1.0 / 6.0) + power * (spread(1.0 / 24.0) + power * spread(1.0 / 120.0))
            fall = unity + power * (unity + power * (spread(0.5) + power * fall))
            for _ in range(6):
                fall *= fall
            attenuation = lesser(spread(4.0) * cos_alpha * lesser(cos_i, spread(cos_r)) * inverse_h, unity)
            f_r = spread(material[0]) + spread(material[1] / cos_r) * attenuation * fall
            part += spread(rules[3, n_q, j]) * f_r * cos_i
        light += scale * part
    return float(total(light))


@kernel
def _sum_any(
    patch: Patch, material: LobeNumbers, rule: DiscRule, low: int, high: int, room: Float32
) -> float:
    """Return the same for a lobe of any shape."""
    _, normal, omega_r = patch
    rules, n, n_q = rule
    light = 0.0
    for i in range(n):
        length = room[high + i] - room[low + i]
        if not length > 0.0:
            continue
        for j in range(n_q):
            t = room[low + i] + length * rules[2, n_q, j]
            level = math.sqrt(1.0 - t * t)
            omega_i = (level * room[AZIMUTH_X + i], level * room[AZIMUTH_Y + i], 0.0 + t)
            cos_i = omega_i[0] * normal[0] + omega_i[1] * normal[1] + omega_i[2] * normal[2]
            light += (
                room[WEIGHT + i]
                * length
                * rules[3, n_q, j]
                * cos_i
                * reflected(material, omega_i, omega_r, normal)
            )
    return light


@kernel(inline=True)
def _light_between(
    between: tuple[float, float],
    patch: Patch,
    center: Point,
    radius: float,
    planes: Float64,
    n_planes: int,
    sheets: SlicedSheets,
    material: LobeNumbers,
    rule: DiscRule,
    room: Float32,
) -> float:
    """Return `lap_light` between two offsets; the `rule` has so many slices, and nodes up each."""
    P, n, has_near = patch.P, rule.n_p, False
    for look in range(MAX_LOOKS):
        if between[1] <= between[0]:
            return 0.0
        all_open, any_open, has_near = lay(
            P=P,
            center=center,
            radius=radius,
            between=between,
            n=n,
            planes=planes,
            n_planes=n_planes,
            sheets=sheets,
            room=room,
        )
        if not any_open:
            return 0.0
        if all_open or look == MAX_LOOKS - 1:
            break
        first, last = open_ends(n, room)
        if first <= SHUT_ENDS and last >= n - 1 - SHUT_ENDS:
            break
        between = open_range(first, last, n, between, room)
    light = 0.0
    for part in range(2 if has_near else 1):
        low, high = (LOW, HIGH) if part == 0 else (NEAR_LOW, NEAR_HIGH)
        if material[3] == 0.0 and material[4] == 0.0:
            light += _sum_round(patch, material, rule, low, high, room)
        else:
            light += _sum_any(patch, material, rule, low, high, room)
    return light


@kernel(fastmath=REDUCTION)
def lap_light(
    patch: Patch,
    center: Point,
    radius: float,
    planes: Float64,
    n_planes: int,
    sheets: SlicedSheets,
    material: LobeNumbers,
    rule: DiscRule,
    room: Float32,
) -> float:
    """Return integral f_r cos(theta_i) d(omega) over the part of the luminous half-sphere that P sees.

    P stands farther than `radius` from the arc's axis. The `rule` is that of the disc.
    """
    P, normal, omega_r = patch
    if normal[0] * omega_r[0] + normal[1] * omega_r[1] + normal[2] * omega_r[2] <= 0.0:
        return 0.0
    rules, n_p, n_q = rule
    to_x, to_y, to_z = center[0] - P[0], center[1] - P[1], center[2] - P[2]
    distance = math.sqrt(to_x * to_x + to_y * to_y + to_z * to_z)
    sin_b, towards = radius / distance, (to_x / distance, to_y / distance, to_z / distance)
    more = more_nodes(sin_b, sin_b / math.sqrt(1.0 - sin_b * sin_b), towards, omega_r, material)
    # Number of slices for each of the disc's nodes across.
    n = min(MAX_SLICES, N_LANES * math.ceil(4 * n_p * more / N_LANES - 1e-6))
    # Number of the disc's nodes up a slice.
    n_q = math.ceil(min(float(MAX_NODES_Q), 0.5 * n_q * more) - 1e-6)
    plan = math.sqrt(to_x * to_x + to_y * to_y)
    low, high = upright_range(radius, plan, to_x / plan, to_y / plan, planes, n_planes)
    parting = parting_offset(P, center, radius, sheets) if sheets.edge_hides else math.nan
    is_parted = low < parting < high
    first_end, light = parting if is_parted else high, 0.0
    for side in range(2 if is_parted else 1):
        between = (low, first_end) if side == 0 else (parting, high)
        light += _light_between(
            between=between,
            patch=patch,
            center=center,
            radius=radius,
            planes=planes,
            n_planes=n_planes,
            sheets=sheets,
            material=material,
            rule=DiscRule(rules, n, n_q),
            room=room,
        )
    return light
