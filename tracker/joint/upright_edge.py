"""Upright edges: no point lies on one, so it lies between the last point before and the first one behind.

Where between them the image's scan lines say.

Which two these are the points say by how far they lie off either face. With points up to one on the face
before and all others on that behind, a place has the likelihood exp(-sum of squares / 2); so the edge's
posterior (a change point's: Hinkley 1970, Biometrika 57, 1) says how far off the two may be.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float64
from noise_model.compiled.kernel import kernel
from tracker.joint.face_change import Columns, change_of_faces, fill_places
from tracker.joint.measured import OFF_SIGMAS, OnFace, meet_face
from tracker.state import DY_MM, DZ_MM, SCAN, SIGMA_PX, Z_MM
from tracker.stripe.edge import stripe_ends
from tracker.stripe.light import StripeLight, apart_px, background_off_px

N_AROUND = 4
"""Number of points next to an edge that determine the y of its scan lines.

Their own scatter does not count (`meet_face`). Farther off a half V's face bends: seen from beside, by 20 its
edge was 0.3 mm off.
"""


class Faces(NamedTuple):
    """Both faces next to an upright edge, carried on to points (n,): their heights, mm, and slopes there."""

    before_mm: Float64
    before_slope: Float64
    behind_mm: Float64
    behind_slope: Float64


@kernel(allocates=True)
def no_faces(n: int) -> Faces:
    """Make room for the faces next to an edge at some points."""
    return Faces(np.empty(n), np.empty(n), np.empty(n), np.empty(n))


@kernel(allocates=True)
def points_around_edge(lines: Float64, faces: Faces, limit_mm: Float64) -> tuple[int, int]:
    """Return `neighbours_of_edge` of points (n,) that lie on a face within limits (n,), 0 for none."""
    n = limit_mm.shape[0]
    on_before, on_behind = np.empty(n, np.bool_), np.empty(n, np.bool_)
    for i in range(n):
        on_before[i] = abs(lines[Z_MM, i] - faces.before_mm[i]) < limit_mm[i]
        on_behind[i] = abs(lines[Z_MM, i] - faces.behind_mm[i]) < limit_mm[i]
    neighbours: tuple[int, int] = neighbours_of_edge(on_before, on_behind)
    return neighbours


@kernel
def neighbours_of_edge(before: Bool, behind: Bool) -> tuple[int, int]:
    """Return the last point (n,) before an edge and the first behind it, -1 without either.

    `before` and `behind` (n,) say which points lie on which side's face, in order of y. The changes that
    put most points on their own side are taken: one on the other side's face by chance is outvoted.
    """
    n, votes, max_votes, first, last = before.shape[0], 0, -before.shape[0], 0, 0
    for i in range(n):
        votes += int(before[i]) - int(behind[i])
        if votes > max_votes:
            max_votes, first = votes, i
        if votes == max_votes:
            last = i
    while first >= 0 and not before[first]:
        first -= 1
    last += 1
    while last < n and not behind[last]:
        last += 1
    return (first, last) if first >= 0 and last < n else (-1, -1)


class EdgeScatter(NamedTuple):
    """The mean square, mm^2, by which an edge is off midway between two points, by all points.

    `beyond_mm2` is what places add to it that lie clear of the two.
    """

    square_mm2: float
    beyond_mm2: float


@kernel
def off_faces(lines: Float64, faces: Faces, i: int, off_px: float, bent_mm: float) -> tuple[float, float]:
    """Return how far point i, of so many px 1 sigma, lies off the face before and that behind, in sigmas."""
    to_before = (lines[DZ_MM, i] - faces.before_slope[i] * lines[DY_MM, i]) * off_px
    to_behind = (lines[DZ_MM, i] - faces.behind_slope[i] * lines[DY_MM, i]) * off_px
    off_before = (lines[Z_MM, i] - faces.before_mm[i]) / math.hypot(to_before, bent_mm)
    off_behind = (lines[Z_MM, i] - faces.behind_mm[i]) / math.hypot(to_behind, bent_mm)
    return off_before, off_behind


@kernel
def limited_run(limit_mm: Float64, first: int, last: int) -> tuple[int, int]:
    """Return the first and the last of the points (n,) with a limit that follow each other about two."""
    while first > 0 and limit_mm[first - 1] > 0.0:
        first -= 1
    while last < limit_mm.shape[0] - 1 and limit_mm[last + 1] > 0.0:
        last += 1
    return first, last


@kernel(allocates=True)
def change_of(
    lines: Float64,
    faces: Faces,
    limit_mm: Float64,
    bent_mm: float,
    column_mm: float,
    light: StripeLight,
    before: int,
    behind: int,
    on_before_mm: Float64,
    on_behind_mm: Float64,
) -> EdgeScatter:
    """Return the error of the place at which points (n,) seem to change faces.

    Points with a limit (n,) count. Any place between scan lines, a column apart, is as likely beforehand. A
    face may be bent by so much, and a centre may be off by what its background makes of a line
    (`background_off_px`). A point that lies off both faces is no evidence. A change lies midway between where
    the last ray before it meets that face (n,) and where the next one meets the other (n,): seen from the
    side, points themselves lie aside with their own scatter.
    """
    first, last = limited_run(limit_mm, before, behind)
    n, farthest = last - first, OFF_SIGMAS * OFF_SIGMAS
    moved_px = background_off_px(light, lines[SCAN][first : last + 1], lines[SIGMA_PX][first : last + 1])
    costs, cost, min_cost = np.empty(n), 0.0, math.inf
    for k in range(n):
        i = first + k
        off_px = math.hypot(lines[SIGMA_PX, i], moved_px[k])
        off_before, off_behind = off_faces(lines, faces, i, off_px, bent_mm)
        cost += min(off_before**2, farthest) - min(off_behind**2, farthest)
        costs[k] = cost
        min_cost = min(min_cost, cost)
    middle_mm = 0.5 * (on_before_mm[before] + on_behind_mm[behind])
    half_mm = 0.5 * column_mm * abs(lines[SCAN, behind] - lines[SCAN, before])
    total, square, beyond = 0.0, 0.0, 0.0
    for k in range(n):
        i = first + k
        wide_mm = column_mm * abs(lines[SCAN][i + 1] - lines[SCAN, i])
        off_mm = 0.5 * (on_before_mm[i] + on_behind_mm[i + 1]) - middle_mm
        weight = wide_mm * math.exp(-0.5 * (costs[k] - min_cost))
        there = weight * (off_mm * off_mm + wide_mm * wide_mm / 12.0)
        total += weight
        square += there
        beyond += there if abs(off_mm) > half_mm + wide_mm else 0.0
    return EdgeScatter(square / total, beyond / total) if total > 0.0 else EdgeScatter(0.0, 0.0)


class Edge(NamedTuple):
    """Place of an upright edge, mm, its variance in its faces, mm^2, and dy by their height."""

    y_mm: float
    variance_mm2: float
    y_per_z: float


@kernel(allocates=True)
def edge_covariance(edge: Edge, height_between: Float64, height_there: Float64, of_faces: Float64) -> Float64:
    """Return the covariance (2, 2) of (y, z) where an edge's y goes with the mean height of both its faces.

    `height_between` (p,) are that height's slopes by the parameters of the faces, whose covariance (p, p) is
    `of_faces`; `height_there` (p,) are those of its own z.
    """
    p = of_faces.shape[0]
    moved, by_faces, covariance = np.empty((2, p)), np.zeros((2, p)), np.zeros((2, 2))
    for j in range(p):
        moved[0, j], moved[1, j] = edge.y_per_z * height_between[j], height_there[j]
    for a in range(2):
        for j in range(p):
            for i in range(p):
                by_faces[a, j] += moved[a, i] * of_faces[i, j]
        for b in range(2):
            for j in range(p):
                covariance[a, b] += by_faces[a, j] * moved[b, j]
    covariance[0, 0] += edge.variance_mm2
    return covariance


class HiddenStrip(NamedTuple):
    """Width of the lower side that an edge hides next to its foot, mm, and its 1 sigma.

    Over `seen_mm` of the lower side's width the camera sees the upright side before it.
    """

    width_mm: float
    sigma_mm: float
    seen_mm: float


@kernel(allocates=True)
def edge_between(
    lines: Float64,
    faces: Faces,
    limit_mm: Float64,
    bent_mm: float,
    column_mm: float,
    light: StripeLight,
    before: int,
    behind: int,
    hidden: HiddenStrip,
    is_profile: bool,
) -> Edge:
    """Return the edge between the two of some points (n,) that `points_around_edge` has found.

    A face may be bent by so much; see `change_of` and `upright_edge`, and `edge_by_columns` of a profile.
    """
    on_before = meet_face(lines, faces.before_mm, faces.before_slope)
    met = meet_face(lines, faces.behind_mm, faces.behind_slope)
    if is_profile:
        by_columns: Edge = edge_by_columns(
            lines,
            faces,
            limit_mm,
            bent_mm=bent_mm,
            column_mm=column_mm,
            before=before,
            hidden=hidden,
            on_before=on_before,
            on_behind_mm=met.y_mm,
        )
        return by_columns
    change = change_of(
        lines,
        faces,
        limit_mm,
        bent_mm=bent_mm,
        column_mm=column_mm,
        light=light,
        before=before,
        behind=behind,
        on_before_mm=on_before.y_mm,
        on_behind_mm=met.y_mm,
    )
    for i in range(before + 1):
        met.y_mm[i], met.y_per_z[i] = on_before.y_mm[i], on_before.y_per_z[i]
    edge: Edge = upright_edge(
        lines[SCAN], column_mm, light, before, behind, hidden=hidden, face=met, change=change
    )
    return edge


@kernel(allocates=True)
def edge_by_columns(
    lines: Float64,
    faces: Faces,
    limit_mm: Float64,
    bent_mm: float,
    column_mm: float,
    before: int,
    hidden: HiddenStrip,
    on_before: OnFace,
    on_behind_mm: Float64,
) -> Edge:
    """Return the edge among a profile's points (n,) by which columns show which face (`face_change`).

    Points with a limit (n,) count; that at `before` lies on the face before. A point off both faces shows
    none.
    """
    first, last = limited_run(limit_mm, before, before)
    farthest = OFF_SIGMAS * OFF_SIGMAS
    n = int(abs(lines[SCAN, last] - lines[SCAN, first])) + 1
    seen, off_before, off_behind = np.zeros(n, np.bool_), np.zeros(n), np.zeros(n)
    before_mm, behind_mm, begin, end = np.full(n, math.nan), np.full(n, math.nan), n, 0
    for i in range(first, last + 1):
        k = int(abs(lines[SCAN, i] - lines[SCAN, first]))
        to_before, to_behind = off_faces(lines, faces, i, lines[SIGMA_PX, i], bent_mm)
        off_before[k], off_behind[k] = min(to_before**2, farthest), min(to_behind**2, farthest)
        off_mm = min(abs(lines[Z_MM, i] - faces.before_mm[i]), abs(lines[Z_MM, i] - faces.behind_mm[i]))
        seen[k] = off_mm < limit_mm[i]
        if seen[k]:
            before_mm[k], behind_mm[k] = on_before.y_mm[i], on_behind_mm[i]
            begin, end = min(begin, k), max(end, k + 1)
    columns = Columns(
        seen[begin:end],
        before_mm[begin:end],
        behind_mm[begin:end],
        off_before[begin:end],
        off_behind[begin:end],
        column_mm,
    )
    fill_places(columns.before_mm)
    fill_places(columns.behind_mm)
    change = change_of_faces(columns, hidden.width_mm, hidden.sigma_mm)
    return Edge(change.y_mm, change.variance_mm2, on_before.y_per_z[before])


@kernel(allocates=True)
def upright_edge(
    scan: Float64,
    column_mm: float,
    light: StripeLight,
    before: int,
    behind: int,
    hidden: HiddenStrip,
    face: OnFace,
    change: EdgeScatter,
) -> Edge:
    """Return the edge between two neighbouring points that lie on either side's face, a column apart.

    `scan` (n,) are the points' lines; where they meet it is `face`. Of the lower side, behind, the edge hides
    a strip. Where between the two points, or how far from them, `change` says; where the image is at hand,
    its scan lines there say how much of them is either side's (`stripe_end`).
    """
    last_mm, first_mm = face.y_mm[before], face.y_mm[behind] - hidden.width_mm
    y_per_z = 0.5 * (face.y_per_z[before] + face.y_per_z[behind])
    spread_mm = max(abs(first_mm - last_mm), column_mm)
    middle_mm = 0.5 * (last_mm + first_mm)
    variance_mm2 = max(spread_mm**2 / 12.0, change.square_mm2) + 0.25 * hidden.sigma_mm**2
    anywhere = Edge(middle_mm, variance_mm2, y_per_z)
    last, first = int(scan[before]), int(scan[behind])
    if light.position_px.shape[0] == 0 or _is_hidden(light, last, first):
        return anywhere
    ends, begins = stripe_ends(light, last, first, hidden.seen_mm / column_mm)
    low, high = max(before - N_AROUND, 0), min(behind + 1 + N_AROUND, scan.shape[0])
    places, variances, n = np.empty(2), np.empty(2), 0
    # What is less sure than the two points is no end.
    if (ends.sigma * column_mm) ** 2 < variance_mm2:
        places[n] = _at_line(face.y_mm[low:before], scan[low:before], ends.line)
        variances[n] = (ends.sigma * column_mm) ** 2
        n += 1
    sigma_mm = math.hypot(begins.sigma * column_mm, hidden.sigma_mm)
    if sigma_mm**2 < variance_mm2:
        there_mm = _at_line(face.y_mm[behind + 1 : high], scan[behind + 1 : high], begins.line)
        places[n], variances[n] = there_mm - hidden.width_mm, sigma_mm**2
        n += 1
    if n == 0:
        # Points on what the upright side mirrors seem to lie on either side's face.
        return Edge(middle_mm, variance_mm2 + hidden.seen_mm**2 / 12.0, y_per_z)
    information, edge_mm, of_both = 0.0, 0.0, 0.0
    for k in range(n):
        information += 1.0 / variances[k]
        edge_mm += places[k] / variances[k]
        of_both += variances[k]
    # What shines from the upright side itself, if it is seen, counts as either's: then they do not agree.
    apart_mm2 = (places[0] - places[n - 1]) ** 2 - of_both
    both = 1.0 + _likeness(light, last, first) if n == 2 else 1.0
    variance_mm2 = both / information + 0.25 * max(apart_mm2, 0.0) + change.beyond_mm2
    return Edge(edge_mm / information, variance_mm2, y_per_z)


@kernel
def _is_hidden(light: StripeLight, last: int, first: int) -> bool:
    """Return True if a line between two hides its stripe under saturated pixels, a glint's."""
    for s in range(min(last, first) + 1, max(last, first)):
        for is_censored in light.censored[s]:
            if is_censored and math.isnan(light.position_px[s]):
                return True
    return False


@kernel
def _likeness(light: StripeLight, last: int, first: int) -> float:
    """Return the correlation of the errors of two lines' stripe ends, 0 to 1: by the overlap of their bells.

    Of stripes that lie in each other's light what one gains the other loses, which moves both ends in common.
    """
    return math.exp(-0.25 * (apart_px(light, last, first) / light.width_px[first]) ** 2)


@kernel
def _at_line(y_mm: Float64, scan: Float64, line: float) -> float:
    """Return the y, mm, at which a scan line crosses the face that some points (n,) lie on."""
    middle, mean_mm, product, square, n = 0.0, 0.0, 0.0, 0.0, scan.shape[0]
    for i in range(n):
        middle += scan[i] / n
        mean_mm += y_mm[i] / n
    for i in range(scan.shape[0]):
        product += (scan[i] - middle) * y_mm[i]
        square += (scan[i] - middle) ** 2
    return float(mean_mm + product / square * (line - middle))


@kernel
def hidden_strip(
    sources_mm: tuple[Float64, ...], edge_y_mm: float, edge_z_mm: float, step_mm: float, slope_sigma: float
) -> HiddenStrip:
    """Return the width of the lower side that an edge hides next to its foot from points (3,), mm.

    The camera comes first. The strip is what the point that hides more leaves dark. It ends below where the
    edge is (`edge_y_mm`, x = 0) by how far the point stands aside, t = (y_edge - y) / (z - z_edge) step; the
    camera sees the upright side over -t. A ray that comes from x passes the edge x / (z - z_edge) step away
    from x = 0, where the edge lies aside by as much as the seam's slope is unknown. A strip cannot be
    narrower than nothing: width and sigma are the mean and deviation of max(0, t). From a point that is not
    above the edge all of it is hidden: infinity.
    """
    widest, sigma_mm, seen_mm = -math.inf, 0.0, math.nan
    for source in sources_mm:
        over_mm = source[2] - edge_z_mm
        if not over_mm > 0.0:
            return HiddenStrip(math.inf, 0.0, 0.0)
        width_mm = (edge_y_mm - source[1]) / over_mm * step_mm
        if math.isnan(seen_mm):
            seen_mm = max(-width_mm, 0.0)
        strip, its_sigma_mm = _not_below_nothing(width_mm, slope_sigma * abs(source[0]) / over_mm * step_mm)
        if strip > widest or (strip == widest and its_sigma_mm > sigma_mm):
            widest, sigma_mm = strip, its_sigma_mm
    return HiddenStrip(widest, sigma_mm, seen_mm)


@kernel
def _not_below_nothing(mean: float, sigma: float) -> tuple[float, float]:
    """Return the mean and deviation of max(0, t) where t is normal, of a mean and 1 sigma."""
    if not sigma > 0.0:
        return max(mean, 0.0), 0.0
    t = mean / sigma
    above = 0.5 * math.erfc(-t / math.sqrt(2.0))
    density = math.exp(-0.5 * t * t) / math.sqrt(2.0 * math.pi)
    width = mean * above + sigma * density
    square = (mean * mean + sigma * sigma) * above + mean * sigma * density
    return width, math.sqrt(max(square - width * width, 0.0))
