"""The kernels that follow bounced light: from the source over the joint's points to the camera."""

from __future__ import annotations

import numpy as np

from noise_model.compiled.arrays import Float32, Float64, Int64, Point
from noise_model.compiled.kernel import kernel
from noise_model.interreflection.first_bounce import Place, arc_leaving, laser_leaving
from noise_model.interreflection.lattice import Lattice, around
from noise_model.interreflection.nodes import (
    COLUMNS,
    FACE,
    OMEGA,
    WEIGHT,
    Focus,
    GaussRules,
    look_around,
    room,
)
from noise_model.interreflection.scratch import Scratch, scratch_for
from noise_model.surface.brdf import reflected
from noise_model.surface.faces import across, strip

ORDERS = 6
"""Number of bounces that are followed."""


def gather_first(
    k: Place, seen: Lattice, camera: Float64, focus: Focus, of_laser: bool, fine: GaussRules
) -> Float64:
    """Return the once-bounced light that points of a lattice (n, 1) send to the camera, source's output 1."""
    nodes, sent = np.empty((room(k, fine), COLUMNS)), np.zeros((len(seen.faces), 1))
    _gather_first(
        k=k,
        seen=seen,
        camera=camera,
        focus=focus,
        of_laser=of_laser,
        fine=fine,
        scratch=scratch_for(k),
        nodes=nodes,
        sent=sent,
    )
    return sent


@kernel
def _gather_first(
    k: Place,
    seen: Lattice,
    camera: Float64,
    focus: Focus,
    of_laser: bool,
    fine: GaussRules,
    scratch: Scratch,
    nodes: Float64,
    sent: Float64,
) -> None:
    for i in range(seen.faces.shape[0]):
        P, normal = seen.points[i], seen.normals[i]
        to_camera = _towards(P, camera)
        for j in range(
            look_around(
                k=k,
                P=P,
                normal=normal,
                on=seen.faces[i],
                focus=focus,
                of_stripe=of_laser,
                rules=fine,
                scratch=scratch,
                nodes=nodes,
            )
        ):
            node = nodes[j]
            f_r = reflected(k.material, node[OMEGA : OMEGA + 3], to_camera, normal)
            sent[i, 0] += f_r * node[WEIGHT] * _leaving(k, node, of_laser, scratch)


@kernel
def _towards(P: Float64, Q: Float64) -> Point:
    """Return the unit vector from P to Q."""
    dx, dy, dz = Q[0] - P[0], Q[1] - P[1], Q[2] - P[2]
    r = (dx * dx + dy * dy + dz * dz) ** 0.5
    return dx / r, dy / r, dz / r


@kernel
def _leaving(k: Place, node: Float64, of_laser: bool, scratch: Scratch) -> float:
    """Return the source's own light that a node sends to the point that looks at it."""
    Q, normal, back = node[:3], node[3:OMEGA], _back(node)
    if of_laser:
        light: float = laser_leaving(k, Q, normal, back)
    else:
        light = arc_leaving(k, Q, normal, back, scratch.borders, scratch.spans)
    return light


@kernel
def _back(node: Float64) -> Point:
    """Return the direction from a node to the point that looks at it."""
    return -node[OMEGA], -node[OMEGA + 1], -node[OMEGA + 2]


def arriving(
    k: Place, passing: Lattice, focus: Focus, of_laser: bool, coarse: GaussRules
) -> tuple[Int64, Float64, Float64]:
    """Return from where how much light comes to the points of a lattice.

    Point i remembers the directions `omega` (n, 3) from start[i] to start[i + 1] and the irradiance (n,
    ORDERS - 1) that comes along each, after 1, 2, … reflections, at the source's output 1.
    """
    n_points, scratch = len(passing.faces), scratch_for(k)
    # Where the nodes of each point begin, and how many of them the source strikes.
    start, struck = np.zeros(n_points + 1, dtype=np.int64), np.zeros(n_points, dtype=np.int64)
    nodes, done, max_nodes = np.empty((0, COLUMNS)), 0, room(k, coarse)
    while done < n_points:
        more = np.empty((max(len(nodes), 16 * max_nodes), COLUMNS))
        nodes = np.concatenate([nodes[: start[done]], more])
        done = _look_from_each(
            k=k,
            passing=passing,
            focus=focus,
            of_laser=of_laser,
            coarse=coarse,
            scratch=scratch,
            max_nodes=max_nodes,
            done=done,
            start=start,
            struck=struck,
            nodes=nodes,
        )
    nodes = nodes[: start[-1]]
    irradiance = np.zeros((len(nodes), ORDERS - 1))
    _strike(k, start, struck, of_laser, scratch, nodes, irradiance)
    # The laser's own light comes from its stripe, what it sends further comes from all faces.
    first = start[:-1] + (struck if of_laser else 0)
    shares = np.empty(_count_shares(k, passing, start, first, scratch, nodes), dtype=np.float32)
    _pass_on(
        k=k,
        passing=passing,
        start=start,
        first=first,
        scratch=scratch,
        nodes=nodes,
        shares=shares,
        irradiance=irradiance,
    )
    return start, nodes[:, OMEGA : OMEGA + 3].copy(), irradiance


@kernel
def _look_from_each(
    k: Place,
    passing: Lattice,
    focus: Focus,
    of_laser: bool,
    coarse: GaussRules,
    scratch: Scratch,
    max_nodes: int,
    done: int,
    start: Int64,
    struck: Int64,
    nodes: Float64,
) -> int:
    """Write the nodes of a lattice's points from point `done` on, as far as there is room; return how far.

    A point has `max_nodes` nodes at most.
    """
    for i in range(done, len(passing.faces)):
        P, normal, face, used = passing.points[i], passing.normals[i], passing.faces[i], start[i]
        if used + 2 * max_nodes > nodes.shape[0]:
            return i
        if of_laser:
            struck[i] = look_around(
                k=k,
                P=P,
                normal=normal,
                on=face,
                focus=focus,
                of_stripe=True,
                rules=coarse,
                scratch=scratch,
                nodes=nodes[used:],
            )
            used += struck[i]
        n = look_around(
            k=k,
            P=P,
            normal=normal,
            on=face,
            focus=focus,
            of_stripe=False,
            rules=coarse,
            scratch=scratch,
            nodes=nodes[used:],
        )
        if not of_laser:
            struck[i] = n
        start[i + 1] = used + n
    return len(passing.faces)


@kernel
def _strike(
    k: Place,
    start: Int64,
    struck: Int64,
    of_laser: bool,
    scratch: Scratch,
    nodes: Float64,
    irradiance: Float64,
) -> None:
    """Fill the irradiance after one reflection."""
    for i in range(struck.shape[0]):
        for j in range(start[i], start[i] + struck[i]):
            irradiance[j, 0] = nodes[j, WEIGHT] * _leaving(k, nodes[j], of_laser, scratch)


@kernel
def _count_shares(
    k: Place, passing: Lattice, start: Int64, first: Int64, scratch: Scratch, nodes: Float64
) -> int:
    """Return the number of directions remembered by the points about all nodes from `first` on."""
    count, which = 0, scratch.which
    for i in range(first.shape[0]):
        for j in range(first[i], start[i + 1]):
            for a in range(_about(k, passing, nodes[j], which, scratch.weights)):
                count += start[which[a] + 1] - start[which[a]]
    return count


@kernel
def _pass_on(
    k: Place,
    passing: Lattice,
    start: Int64,
    first: Int64,
    scratch: Scratch,
    nodes: Float64,
    shares: Float32,
    irradiance: Float64,
) -> None:
    """Fill the irradiance after 2, 3, … reflections from that after one, over nodes from `first` on.

    `shares` is room for which share of what arrives along each remembered direction leaves towards the point.
    """
    which, weights = scratch.which, scratch.weights
    for order in range(ORDERS - 1):
        entry = 0
        for i in range(first.shape[0]):
            for j in range(first[i], start[i + 1]):
                back = _back(nodes[j])
                total = 0.0
                for a in range(_about(k, passing, nodes[j], which, weights)):
                    n = passing.normals[which[a]]
                    for m in range(start[which[a]], start[which[a] + 1]):
                        if order == 0:
                            shares[entry] = weights[a] * reflected(
                                k.material, nodes[m, OMEGA : OMEGA + 3], back, n
                            )
                        else:
                            total += shares[entry] * irradiance[m, order - 1]
                        entry += 1
                if order > 0:
                    irradiance[j, order] = nodes[j, WEIGHT] * total


@kernel(inline=True)
def _about(k: Place, passing: Lattice, node: Float64, which: Int64, weights: Float64) -> int:
    """Write the lattice's points about a node and their weights; return how many."""
    face = int(node[FACE])
    s = across(node, strip(face, k.vertices), k.corrugation)
    return around(passing, face, s, node[0], which, weights)


def gather_further(
    k: Place,
    seen: Lattice,
    camera: Float64,
    focus: Focus,
    passing: Lattice,
    coarse: GaussRules,
    start: Int64,
    omega: Float64,
    irradiance: Float64,
) -> Float64:
    """Return the light that points of a lattice (n, ORDERS - 1) send to the camera after 2, 3, … bounces."""
    nodes, sent = np.empty((room(k, coarse), COLUMNS)), np.zeros((len(seen.faces), ORDERS - 1))
    _gather_further(
        k=k,
        seen=seen,
        camera=camera,
        focus=focus,
        passing=passing,
        coarse=coarse,
        start=start,
        omega=omega,
        irradiance=irradiance,
        scratch=scratch_for(k),
        nodes=nodes,
        sent=sent,
    )
    return sent


@kernel
def _gather_further(
    k: Place,
    seen: Lattice,
    camera: Float64,
    focus: Focus,
    passing: Lattice,
    coarse: GaussRules,
    start: Int64,
    omega: Float64,
    irradiance: Float64,
    scratch: Scratch,
    nodes: Float64,
    sent: Float64,
) -> None:
    which, weights = scratch.which, scratch.weights
    for i in range(seen.faces.shape[0]):
        P, normal = seen.points[i], seen.normals[i]
        to_camera = _towards(P, camera)
        for j in range(
            look_around(
                k=k,
                P=P,
                normal=normal,
                on=seen.faces[i],
                focus=focus,
                of_stripe=False,
                rules=coarse,
                scratch=scratch,
                nodes=nodes,
            )
        ):
            node = nodes[j]
            onward = node[WEIGHT] * reflected(k.material, node[OMEGA : OMEGA + 3], to_camera, normal)
            back = _back(node)
            for a in range(_about(k, passing, node, which, weights)):
                n = passing.normals[which[a]]
                for m in range(start[which[a]], start[which[a] + 1]):
                    f_r = reflected(k.material, omega[m], back, n)
                    for order in range(ORDERS - 1):
                        sent[i, order] += onward * weights[a] * f_r * irradiance[m, order]
