"""From where light comes to a surface point: nodes of the integral over all that it sees of the joint.

A point P receives integral L(Q -> P) cos(theta_P) cos(theta_Q) / r^2 dA over the points Q that it sees. The
nodes lie in angles about P, in which that integral is smooth even where two faces meet:

- another face, a straight strip along x: Q is at the angle phi from the strip's perpendicular in the section
  and at psi along it, s = s_0 + d tan(phi), x = x_P + rho tan(psi). Where a corrugation raises the section,
  the same numbers are taken in the sheared section, and the kernel is still that of the true points;
- a corrugated sheet, seen from itself or from the other one: straight along y, so x is taken piece by piece
  of the corrugation and y = y_P + r tan(psi).

Light of the laser comes from its stripe alone: there the nodes along x lie across the stripe.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from noise_model.arc.quadrature import gauss_nodes
from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel
from noise_model.instrument.laser import depth_below, tangent_plane
from noise_model.interreflection.first_bounce import Place, sees
from noise_model.interreflection.scratch import PSI_KNOTS, X_KNOTS, Y_KNOTS, Scratch
from noise_model.surface.faces import face_point, ridge, slanted, strip

Rule = tuple[Float64, Float64]

OMEGA, WEIGHT, FACE, COLUMNS = 6, 9, 10, 11
"""A node's columns: Q, its normal, then the direction from P, the weight cos(theta_P) d(omega), the face."""

ACROSS_SIGMA = 3.5
"""Reach of the nodes across the stripe."""

MIN_SLOPE = 0.05
"""A sheet that meets a line of the surface at a smaller slope than this makes no stripe across it."""


class GaussRules(NamedTuple):
    """Gauss-Legendre nodes and weights on [0, 1]: per piece of phi, psi, x, y, and of the stripe's width.

    With `closely` psi is cut into pieces of 30 degrees, and x, y and psi about the brightest place.
    """

    phi: Rule
    psi: Rule
    x: Rule
    y: Rule
    across: Rule
    closely: bool


def rules(phi: int, psi: int, x: int, y: int, across: int, closely: bool) -> GaussRules:
    """Return the rules with so many nodes each."""

    def gauss(n: int) -> Rule:
        return gauss_nodes()[2, n, :n], gauss_nodes()[3, n, :n]

    return GaussRules(gauss(phi), gauss(psi), gauss(x), gauss(y), gauss(across), closely)


class Focus(NamedTuple):
    """Station of the brightest light along the joint, and the scale on which it varies there, mm."""

    x: float
    y: float
    extent: float


def room(k: Place, rules: GaussRules) -> int:
    """Return the largest number of nodes of one surface point."""
    n_faces = k.vertices.shape[0] - 1
    n_psi = max((PSI_KNOTS + 1) * rules.psi[0].shape[0], 3 * rules.across[0].shape[0])
    # Both plates that run on are looked at in two halves.
    max_nodes: int = (n_faces + 2) * rules.phi[0].shape[0] * n_psi
    if k.corrugation[0] > 0.0:
        n_y = rules.y[0].shape[0]
        n_x = (X_KNOTS + 1) * rules.x[0].shape[0]
        max_nodes += 2 * max(n_x * (Y_KNOTS + 1) * n_y, 2 * n_y * rules.across[0].shape[0])
    return max_nodes


@kernel
def _add(
    k: Place,
    P: Float64,
    normal: Float64,
    face: int,
    s: float,
    x: float,
    measure: float,
    nodes: Float64,
    count: int,
) -> int:
    """Write the node at (s, x) of a face if P sees it; `measure` is ds dx. Return how many there are then."""
    on = strip(face, k.vertices)
    _, qy, qz = face_point(x, s, on, k.corrugation)
    dx, dy, dz = x - P[0], qy - P[1], qz - P[2]
    square = dx * dx + dy * dy + dz * dz
    if square < 1e-18:
        return count
    _, slope = ridge(x, k.corrugation)
    (nx, ny, nz), area = slanted(slope, on)
    r = math.sqrt(square)
    cos_p = (dx * normal[0] + dy * normal[1] + dz * normal[2]) / r
    cos_q = -(dx * nx + dy * ny + dz * nz) / r
    if cos_p <= 1e-9 or cos_q <= 1e-9:
        return count
    if not sees((P[0], P[1], P[2]), (x, qy, qz), k.vertices, k.corrugation):
        return count
    node = nodes[count]
    node[0], node[1], node[2] = x, qy, qz
    node[3], node[4], node[5] = nx, ny, nz
    node[OMEGA], node[OMEGA + 1], node[OMEGA + 2] = dx / r, dy / r, dz / r
    node[WEIGHT] = cos_p * cos_q / square * area * measure
    node[FACE] = face
    return count + 1


@kernel
def stripe_at(k: Place, face: int, s: float) -> tuple[float, float]:
    """Return the station at which the laser's sheet meets a line of a face, and its sigma along x; mm.

    NaN where the sheet runs along that line.
    """
    y_0, z_0, ty, tz, _ = strip(face, k.vertices)
    y, z = y_0 + s * ty, z_0 + s * tz
    n_x, n_y, n_z, d = k.sheet.plane[0], k.sheet.plane[1], k.sheet.plane[2], k.sheet.plane[3]
    if abs(n_x) < MIN_SLOPE:
        return math.nan, math.nan
    x = -(n_y * y + n_z * z + d) / n_x
    climb = n_x
    c = 0.0
    for _ in range(12):
        c, slope = ridge(x, k.corrugation)
        if k.sheet.bow != 0.0:
            n_x, n_y, n_z, d = tangent_plane(k.sheet, (x, y, z + c))
        climb = n_x + n_z * slope
        if abs(climb) < MIN_SLOPE:
            return math.nan, math.nan
        x -= (n_x * x + n_z * c + (n_y * y + n_z * z + d)) / climb
    depth = depth_below(k.sheet, (x, y, z + c))
    return x, k.sheet.sigma * depth / k.sheet.stand / abs(climb)


@kernel
def _cut(knots: Float64, n_knots: int, low: float, high: float, cuts: Float64) -> int:
    """Write the borders of the pieces that knots cut a range into; return how many pieces there are."""
    cuts[0] = low
    # Few knots are put in their order by hand: NumPy's sorts take seconds to compile.
    n = 1
    for k in range(n_knots):
        knot = knots[k]
        if not low + 1e-9 < knot < high - 1e-9:
            continue
        i = n
        while cuts[i - 1] > knot:
            i -= 1
        if cuts[i - 1] == knot:
            continue
        for j in range(n, i, -1):
            cuts[j] = cuts[j - 1]
        cuts[i] = knot
        n += 1
    cuts[n] = high
    return n


@kernel
def _from_strip(
    k: Place,
    P: Float64,
    normal: Float64,
    face: int,
    focus: Focus,
    of_stripe: bool,
    rules: GaussRules,
    scratch: Scratch,
    nodes: Float64,
    count: int,
) -> int:
    """Write the nodes on a strip along x that P does not lie on."""
    y_0, z_0, ty, tz, width = strip(face, k.vertices)
    c, _ = ridge(P[0], k.corrugation)
    py, pz = P[1] - y_0, P[2] - c - z_0
    s_0, d = py * ty + pz * tz, pz * ty - py * tz
    if d < 1e-9:
        return count
    knots, cuts = scratch.knots, scratch.cuts
    first, last = math.atan(-s_0 / d), math.atan((width - s_0) / d)
    n_phi = rules.phi[0].shape[0]
    # A plate that runs on is lit least evenly: it is looked at in two halves.
    halves = 2 if face in (0, k.vertices.shape[0] - 2) else 1
    half = (last - first) / halves
    for i in range(halves * n_phi):
        phi = first + half * (i // n_phi + rules.phi[0][i % n_phi])
        cos_phi = math.cos(phi)
        s, rho = s_0 + d * math.tan(phi), d / cos_phi
        ds = d / (cos_phi * cos_phi) * half * rules.phi[1][i % n_phi]
        if of_stripe:
            x_stripe, sigma = stripe_at(k, face, s)
            if math.isnan(x_stripe):
                continue
            reach = ACROSS_SIGMA * sigma
            low = math.atan((x_stripe - reach - P[0]) / rho)
            high = math.atan((x_stripe + reach - P[0]) / rho)
            knots[0], knots[1] = 0.0, math.atan((x_stripe - P[0]) / rho)
            n_pieces = _cut(knots, 2, low, high, cuts)
            psi_rule = rules.across
        else:
            right = 0.5 * math.pi
            knots[0], knots[1] = 0.0, math.atan((focus.x - P[0]) / rho)
            if rules.closely:
                for j, share in enumerate((-2.0, -1.0, 1.0, 2.0)):
                    knots[j + 2] = share * right / 3.0
                    knots[j + 6] = math.atan((focus.x + 0.5 * share * focus.extent - P[0]) / rho)
            n_pieces = _cut(knots, PSI_KNOTS if rules.closely else 2, -right, right, cuts)
            psi_rule = rules.psi
        for piece in range(n_pieces):
            span = cuts[piece + 1] - cuts[piece]
            for j in range(psi_rule[0].shape[0]):
                psi = cuts[piece] + span * psi_rule[0][j]
                cos_psi = math.cos(psi)
                dx = rho / (cos_psi * cos_psi) * span * psi_rule[1][j]
                count = _add(
                    k=k,
                    P=P,
                    normal=normal,
                    face=face,
                    s=s,
                    x=P[0] + rho * math.tan(psi),
                    measure=ds * dx,
                    nodes=nodes,
                    count=count,
                )
    return count


@kernel
def _from_sheet(
    k: Place,
    P: Float64,
    normal: Float64,
    on: int,
    face: int,
    focus: Focus,
    rules: GaussRules,
    scratch: Scratch,
    nodes: Float64,
    count: int,
) -> int:
    """Write the nodes on a corrugated sheet, that of P (face `on`) or the other one."""
    y_0, z_0, _, _, width = strip(face, k.vertices)
    _, bump, pitch = k.corrugation
    knots, cuts, sides, side_cuts = scratch.knots, scratch.cuts, scratch.sides, scratch.side_cuts
    n = 0
    for i in range(-2, 3):
        crest_x = pitch * (math.floor(P[0] / pitch + 0.5) + i)
        for share in (-0.5, -0.25, 0.0, 0.25, 0.5):
            knots[n] = crest_x + share * bump
            n += 1
        knots[n] = crest_x + 0.5 * pitch
        n += 1
    knots[n] = P[0]
    n += 1
    for share in (-1.0, -0.5, 0.0, 0.5, 1.0):
        if rules.closely or share == 0.0:
            knots[n] = focus.x + share * focus.extent
            n += 1
    for piece in range(_cut(knots, n, P[0] - pitch, P[0] + pitch, cuts)):
        span = cuts[piece + 1] - cuts[piece]
        for i in range(rules.x[0].shape[0]):
            x = cuts[piece] + span * rules.x[0][i]
            c, slope = ridge(x, k.corrugation)
            dx, dz = x - P[0], z_0 + c - P[2]
            # Level along y, neither cosine changes its sign over y.
            if dx * normal[0] + dz * normal[2] <= 1e-9 or dx * slope - dz <= 1e-9:
                continue
            here, there = (P[0], P[1], P[2]), (x, P[1], z_0 + c)
            if on == face and not sees(here, there, k.vertices, k.corrugation):
                continue
            r = math.sqrt(dx * dx + dz * dz)
            sides[0] = 0.0
            for j, share in enumerate((-1.0, -0.5, 0.5, 1.0)):
                if rules.closely:
                    sides[j + 1] = math.atan((focus.y + share * focus.extent - P[1]) / r)
            low, high = math.atan((y_0 - P[1]) / r), math.atan((y_0 + width - P[1]) / r)
            for part in range(_cut(sides, Y_KNOTS if rules.closely else 1, low, high, side_cuts)):
                y_span = side_cuts[part + 1] - side_cuts[part]
                for j in range(rules.y[0].shape[0]):
                    psi = side_cuts[part] + y_span * rules.y[0][j]
                    cos_psi = math.cos(psi)
                    measure = span * rules.x[1][i] * r / (cos_psi * cos_psi) * y_span * rules.y[1][j]
                    s = P[1] + r * math.tan(psi) - y_0
                    count = _add(
                        k=k,
                        P=P,
                        normal=normal,
                        face=face,
                        s=s,
                        x=x,
                        measure=measure,
                        nodes=nodes,
                        count=count,
                    )
    return count


@kernel
def _from_stripe_on_sheet(
    k: Place,
    P: Float64,
    normal: Float64,
    face: int,
    rules: GaussRules,
    scratch: Scratch,
    nodes: Float64,
    count: int,
) -> int:
    """Write the nodes across the stripe on a corrugated sheet."""
    y_0, z_0, _, _, width = strip(face, k.vertices)
    x_stripe, sigma = stripe_at(k, face, min(max(P[1] - y_0, 0.0), width))
    if math.isnan(x_stripe):
        return count
    c, _ = ridge(x_stripe, k.corrugation)
    r = max(math.hypot(x_stripe - P[0], z_0 + c - P[2]), sigma)
    sides, cuts = scratch.sides, scratch.side_cuts
    sides[0] = 0.0
    low, high = math.atan((y_0 - P[1]) / r), math.atan((y_0 + width - P[1]) / r)
    for part in range(_cut(sides, 1, low, high, cuts)):
        y_span = cuts[part + 1] - cuts[part]
        for j in range(rules.y[0].shape[0]):
            psi = cuts[part] + y_span * rules.y[0][j]
            cos_psi = math.cos(psi)
            s = P[1] + r * math.tan(psi) - y_0
            dy = r / (cos_psi * cos_psi) * y_span * rules.y[1][j]
            x_stripe, sigma = stripe_at(k, face, s)
            if math.isnan(x_stripe):
                continue
            span = 2.0 * ACROSS_SIGMA * sigma
            for i in range(rules.across[0].shape[0]):
                x = x_stripe + span * (rules.across[0][i] - 0.5)
                count = _add(
                    k=k,
                    P=P,
                    normal=normal,
                    face=face,
                    s=s,
                    x=x,
                    measure=dy * span * rules.across[1][i],
                    nodes=nodes,
                    count=count,
                )
    return count


@kernel
def look_around(
    k: Place,
    P: Float64,
    normal: Float64,
    on: int,
    focus: Focus,
    of_stripe: bool,
    rules: GaussRules,
    scratch: Scratch,
    nodes: Float64,
) -> int:
    """Write the nodes (n, COLUMNS) of all that a point of face `on` sees of the joint; return how many.

    n is `room` at least: nothing is left out. `of_stripe` places them on the laser's stripe instead of on
    all faces.
    """
    count = 0
    corrugated = k.corrugation[0] > 0.0
    for face in range(k.vertices.shape[0] - 1):
        # Only a lap is corrugated: face 1 is its edge.
        if corrugated and face != 1 and on != 1:
            if of_stripe:
                count = _from_stripe_on_sheet(
                    k=k, P=P, normal=normal, face=face, rules=rules, scratch=scratch, nodes=nodes, count=count
                )
            else:
                count = _from_sheet(
                    k=k,
                    P=P,
                    normal=normal,
                    on=on,
                    face=face,
                    focus=focus,
                    rules=rules,
                    scratch=scratch,
                    nodes=nodes,
                    count=count,
                )
        elif face != on:
            count = _from_strip(
                k=k,
                P=P,
                normal=normal,
                face=face,
                focus=focus,
                of_stripe=of_stripe,
                rules=rules,
                scratch=scratch,
                nodes=nodes,
                count=count,
            )
    return count
