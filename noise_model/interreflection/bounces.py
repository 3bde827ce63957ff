"""The kernels that follow bounced light: from the source over the joint's points to the camera."""

from __future__ import annotations

import numpy as np

from noise_model.arrays import Float64, Int64
from noise_model.interreflection.first_bounce import Place, arc_leaving, laser_leaving
from noise_model.interreflection.lattice import Lattice, around
from noise_model.interreflection.nodes import (
    COLUMNS,
    FACE,
    OMEGA,
    WEIGHT,
    Focus,
    Rules,
    look_around,
    room,
)
from noise_model.kernel import kernel
from noise_model.surface.brdf import reflected
from noise_model.surface.faces import across, strip

ORDERS = 6
"""How many bounces are followed."""


@kernel(allocates=True)
def gather_first(
    k: Place, seen: Lattice, camera: Float64, focus: Focus, of_laser: bool, fine: Rules
) -> Float64:
    """Return what points of a lattice (n, 1) send to the camera of once-bounced light, source's output 1."""
    nodes, omega = np.empty((room(k, fine), COLUMNS)), np.empty(3)
    sent = np.zeros((len(seen.faces), 1))
    for i in range(len(seen.faces)):
        P, normal = seen.points[i], seen.normals[i]
        _towards(P, camera, omega)
        n = look_around(k, P, normal, seen.faces[i], focus, of_laser, fine, nodes)
        for j in range(n):
            o = nodes[j, OMEGA : OMEGA + 3]
            f_r = reflected(k.material, o, omega, normal)
            sent[i, 0] += f_r * nodes[j, WEIGHT] * _leaving(k, nodes[j], of_laser)
    return sent


@kernel(inline=True)
def _towards(P: Float64, Q: Float64, omega: Float64) -> None:
    """Write the unit vector from P to Q."""
    r = 0.0
    for a in range(3):
        omega[a] = Q[a] - P[a]
        r += omega[a] * omega[a]
    r = r**0.5
    for a in range(3):
        omega[a] /= r


@kernel(allocates=True, inline=True)
def _leaving(k: Place, node: Float64, of_laser: bool) -> float:
    """Return what a node sends of the source's own light to the point that looks at it."""
    Q, normal, o = node[:3], node[3:OMEGA], node[OMEGA : OMEGA + 3]
    back = (-o[0], -o[1], -o[2])
    return laser_leaving(k, Q, normal, back) if of_laser else arc_leaving(k, Q, normal, back)


@kernel
def _copy(source: Float64, n: int, target: Float64, start: int) -> None:
    """Copy n rows to a table's rows from `start` on.

    A slice that is assigned makes numba compile the message of shapes that do not fit.
    """
    for i in range(n):
        for column in range(source.shape[1]):
            target[start + i, column] = source[i, column]


@kernel(allocates=True)
def arriving(
    k: Place, passing: Lattice, focus: Focus, of_laser: bool, coarse: Rules
) -> tuple[Int64, Float64, Float64]:
    """Return from where how much light comes to the points of a lattice.

    Point i remembers the directions `omega` (n, 3) from start[i] to start[i + 1] and the irradiance (n,
    ORDERS - 1) that comes along each, after 1, 2, … reflections, at the source's output 1.
    """
    n_points = len(passing.faces)
    start = np.zeros(n_points + 1, dtype=np.int64)
    all_nodes, used = np.empty((1024, COLUMNS)), 0
    struck = np.zeros(n_points, dtype=np.int64)
    nodes = np.empty((room(k, coarse), COLUMNS))
    for i in range(n_points):
        # The laser's own light comes from its stripe, what it sends further comes from all faces.
        for of_stripe in (True, False):
            if of_stripe and not of_laser:
                continue
            n = look_around(
                k, passing.points[i], passing.normals[i], passing.faces[i], focus, of_stripe, coarse, nodes
            )
            if used + n > len(all_nodes):
                larger = np.empty((2 * len(all_nodes) + n, COLUMNS))
                _copy(all_nodes, used, larger, 0)
                all_nodes = larger
            _copy(nodes, n, all_nodes, used)
            used += n
            if of_stripe or not of_laser:
                struck[i] = n
        start[i + 1] = used
    all_nodes = all_nodes[:used]
    omega = all_nodes[:, OMEGA : OMEGA + 3].copy()
    irradiance = np.zeros((used, ORDERS - 1))
    for i in range(n_points):
        for j in range(start[i], start[i] + struck[i]):
            irradiance[j, 0] = all_nodes[j, WEIGHT] * _leaving(k, all_nodes[j], of_laser)
    _pass_on(k, passing, start, struck if of_laser else np.zeros_like(struck), all_nodes, omega, irradiance)
    return start, omega, irradiance


@kernel(allocates=True, inline=True)
def _pass_on(
    k: Place,
    passing: Lattice,
    start: Int64,
    first: Int64,
    all_nodes: Float64,
    omega: Float64,
    irradiance: Float64,
) -> None:
    """Fill the irradiance after 2, 3, … reflections from that after one, over nodes from start + first on."""
    which, weights = np.empty(8, dtype=np.int64), np.empty(8)
    # Which share of what arrives along each remembered direction leaves towards the node's point.
    most = 0
    for i in range(len(first)):
        for j in range(start[i] + first[i], start[i + 1]):
            for a in range(_about(k, passing, all_nodes[j], which, weights)):
                most += start[which[a] + 1] - start[which[a]]
    shares = np.empty(most, dtype=np.float32)
    for order in range(ORDERS - 1):
        entry = 0
        for i in range(len(first)):
            for j in range(start[i] + first[i], start[i + 1]):
                back = (-all_nodes[j, OMEGA], -all_nodes[j, OMEGA + 1], -all_nodes[j, OMEGA + 2])
                total = 0.0
                for a in range(_about(k, passing, all_nodes[j], which, weights)):
                    n = passing.normals[which[a]]
                    for m in range(start[which[a]], start[which[a] + 1]):
                        if order == 0:
                            shares[entry] = weights[a] * reflected(k.material, omega[m], back, n)
                        else:
                            total += shares[entry] * irradiance[m, order - 1]
                        entry += 1
                if order > 0:
                    irradiance[j, order] = all_nodes[j, WEIGHT] * total


@kernel(inline=True)
def _about(k: Place, passing: Lattice, node: Float64, which: Int64, weights: Float64) -> int:
    """Write the lattice's points about a node and their weights; return how many."""
    face = int(node[FACE])
    s = across(node, strip(face, k.vertices), k.corrugation)
    return around(passing, face, s, node[0], which, weights)


@kernel(allocates=True)
def gather_further(
    k: Place,
    seen: Lattice,
    camera: Float64,
    focus: Focus,
    passing: Lattice,
    coarse: Rules,
    start: Int64,
    omega: Float64,
    irradiance: Float64,
) -> Float64:
    """Return what points of a lattice (n, ORDERS - 1) send to the camera after 2, 3, … bounces."""
    nodes, to_camera = np.empty((room(k, coarse), COLUMNS)), np.empty(3)
    which, weights = np.empty(8, dtype=np.int64), np.empty(8)
    sent = np.zeros((len(seen.faces), ORDERS - 1))
    for i in range(len(seen.faces)):
        P, normal = seen.points[i], seen.normals[i]
        _towards(P, camera, to_camera)
        count = look_around(k, P, normal, seen.faces[i], focus, False, coarse, nodes)
        for j in range(count):
            o = nodes[j, OMEGA : OMEGA + 3]
            onward = nodes[j, WEIGHT] * reflected(k.material, o, to_camera, normal)
            back = (-o[0], -o[1], -o[2])
            for a in range(_about(k, passing, nodes[j], which, weights)):
                n = passing.normals[which[a]]
                for m in range(start[which[a]], start[which[a] + 1]):
                    f_r = reflected(k.material, omega[m], back, n)
                    for order in range(ORDERS - 1):
                        sent[i, order] += onward * weights[a] * f_r * irradiance[m, order]
    return sent
