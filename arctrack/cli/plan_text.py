"""A plan in words: the designs worth a look, the paper's two rules, where the sensor is blind."""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from arctrack.printable import printable
from noise_model.plan.plan import Plan
from noise_model.plan.remedies import Cure
from noise_model.plan.rules import DesignRule
from noise_model.plan.search import DesignCandidate
from sim_to_real.decision.setup_cost import SetupCost, SizeKind

SHOWN_MM = 0.001
"""Shortest shift of the seam for which an effect is printed, mm."""

MAX_STRETCHES = 12
"""Blind stretches that are printed; path.csv has them all."""


def print_plan(console: Console, plan: Plan) -> None:
    """Print the tables."""
    console.print(_designs(plan))
    for rule_lines in (_rules(plan), _path(plan)):
        console.print()
        for text in rule_lines:
            console.print(printable(text), markup=False, soft_wrap=True)
    if plan.cures:
        console.print(_cures(plan))
    for name in plan.left_out:
        console.print(f"left out: [effects.{name}], which hardly moves σ", markup=False, soft_wrap=True)
    if len(plan.cures) > MAX_STRETCHES:
        console.print(f"and {len(plan.cures) - MAX_STRETCHES} more stretches, see path.csv", markup=False)


def print_costs(console: Console, costs: Sequence[SetupCost]) -> None:
    """Print what effects cost the seam, at a typical size and at one sigma, the largest first."""
    typical = {each.cost.id: each for each in costs if each.kind is SizeKind.TYPICAL}
    one_sigma = {each.cost.id: each for each in costs if each.kind is not SizeKind.TYPICAL}
    shown = [name for name in typical if max(map(_size_mm, _sizes(name, typical, one_sigma))) >= SHOWN_MM]
    if not shown:
        return
    table = Table(
        title="cost of an effect that the tracker does not know, mm of seam",
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    table.add_column("effect", no_wrap=True)
    for heading in ("typical\nside", "\nheight", "1 sigma\nside", "\nheight"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("1 sigma of", no_wrap=True)
    shown.sort(key=lambda name: -max(map(_size_mm, _sizes(name, typical, one_sigma))))
    for name in shown:
        sigma = one_sigma.get(name)
        table.add_row(
            name, *_cost_cells(typical[name]), *_cost_cells(sigma), sigma.kind.value if sigma else ""
        )
    console.print(table)
    console.print(f"effects that cost less than {SHOWN_MM:g} mm are in costs.csv", markup=False)


def _sizes(
    name: str, typical: Mapping[str, SetupCost], one_sigma: Mapping[str, SetupCost]
) -> Iterator[SetupCost]:
    yield typical[name]
    if name in one_sigma:
        yield one_sigma[name]


def _size_mm(each: SetupCost) -> float:
    """Return the shift that ranks a cost, mm: a seam that is lost comes first, what is unknown last."""
    return each.cost.max_mm if each.cost.is_rendered else 0.0


def _cost_cells(each: SetupCost | None) -> tuple[str, str]:
    if each is None or not each.cost.is_rendered:
        return "", ""
    if each.cost.n_lost:
        return "lost", "lost"
    return f"{each.cost.lateral_mm.value:.3f}", f"{each.cost.vertical_mm.value:.3f}"


def _designs(plan: Plan) -> Table:
    """Return the designs, narrow enough for a terminal of 80 columns: units stand in the heads."""
    table = Table(
        title="sensor designs: 1 sigma of the seam against preview and stand-off",
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        padding=0,
    )
    headings = ("", "σ\nµm", "σ y\nµm", "σ z\nµm", "tilt\n°", "azim\n°", "prev\nmm", "stand\nmm")
    for heading in (*headings, "filt\nnm", "exp\nms", "tri\n°", "σ\npx", "arc/\nstr", "blind\n%"):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for name, candidate in [("yours", plan.own), *(("", c) for c in plan.front)]:
        table.add_row(name, *_cells(candidate))
    table.caption = "azim: azimuth, prev: preview, stand: stand-off, tri: triangulation, str: stripe"
    table.caption_justify, table.caption_style = "left", ""
    return table


def _cells(candidate: DesignCandidate) -> Iterator[str]:
    design = candidate.design
    for sigma_mm in (candidate.sigma_mm, candidate.sigma_y_mm, candidate.sigma_z_mm):
        yield _number(1e3 * sigma_mm) if sigma_mm < 0.1 else _whole(1e3 * sigma_mm)
    yield f"{design.tilt_deg:.0f}"
    yield f"{design.azimuth_deg:.0f}"
    yield f"{design.preview_mm:.0f}"
    yield f"{design.stand_off_mm:.0f}"
    yield f"{design.filter_fwhm_nm:g}"
    yield f"{1e3 * design.exposure_s:.2f}"
    yield f"{design.triangulation_deg:.0f}"
    yield _number(candidate.sigma_px)
    yield _number(candidate.arc_over_stripe)
    yield f"{100.0 * candidate.blind_share:.0f}"


def _rules(plan: Plan) -> Iterator[str]:
    """Yield the paper's rules as outcomes for the user's material."""
    rules = plan.rules
    yield f"the paper's rules, for {plan.setup.material.name} and this joint:"
    yield f"  small tilt: {_outcomes(rules.tilt, 'tilt')}"
    yield f"  small tilt of the whole head, laser included: {_outcomes(rules.head, 'tilt')}"
    yield f"  out of the plane of incidence: {_outcomes(rules.azimuth, 'azimuth')}"
    for name, rule in (("tilt", rules.tilt), ("head", rules.head), ("azimuth", rules.azimuth)):
        yield f"  {name:8}" + "".join(f"{angle:>9.0f}°" for angle in rule.angles_deg)
        yield "  arc/str." + "".join(f"{_number(c.arc_over_stripe):>10}" for c in rule.tried)
        yield "  σ mm    " + "".join(f"{_number(c.sigma_mm):>10}" for c in rule.tried)
        yield "  σ z mm  " + "".join(f"{_number(c.sigma_z_mm):>10}" for c in rule.tried)


def _outcomes(rule: DesignRule, angle: str) -> str:
    if math.isnan(rule.light_ratio):
        return "cannot be told: fewer than two angles show the whole path"
    return (
        f"for the light it {rule.light.value} (arc over stripe at {angle} {rule.broken_deg:.0f}° is "
        f"{_number(rule.light_ratio)} times that at {rule.kept_deg:.0f}°), for the seam it {rule.seam.value} "
        f"(σ {_number(rule.seam_ratio)} times; least at {rule.best_deg:.0f}°)"
    )


def _path(plan: Plan) -> Iterator[str]:
    along = plan.along
    station, sigma = along.path.station_mm, along.column("sigma_mm")
    known = sigma[np.isfinite(sigma)]
    reach = f"{station[0]:.0f} to {station[-1]:.0f} mm of {along.path.length_mm:.0f} mm"
    yield f"path: {len(station)} stations, {reach}"
    if len(known):
        median, most = (_number(float(value)) for value in (np.median(known), known.max()))
        yield f"  seam's σ {median} mm in the median, {most} mm at most"
    blind = sum(cure.last - cure.first + 1 for cure in plan.cures)
    if not blind:
        yield f"  nowhere blind: σ is below {plan.limit_mm:g} mm at every station"
    else:
        yield (
            f"  blind (σ above {plan.limit_mm:g} mm or unknown) at {blind} of {len(station)} stations; "
            "what helps, each by itself, and the σ that it leaves:"
        )


def _cures(plan: Plan) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in (
        "torch at\nmm",
        "exposure\nms",
        "σ\nmm",
        "lean °\ntravel, work",
        "σ\nmm",
        "camera °\ntilt, azimuth",
        "σ\nmm",
    ):
        table.add_column(heading, justify="right", no_wrap=True)
    station = plan.along.path.station_mm
    for cure in plan.cures[:MAX_STRETCHES]:
        table.add_row(f"{station[cure.first]:.0f} to {station[cure.last]:.0f}", *_cure_cells(cure))
    return table


def _cure_cells(cure: Cure) -> Iterator[str]:
    moved = cure.moved.design
    yield from _if_seen(f"{1e3 * cure.exposed.design.exposure_s:.2f}", cure.exposed)
    yield from _if_seen(f"{cure.lean_deg[0]:+.0f}, {cure.lean_deg[1]:+.0f}", cure.leaned)
    yield from _if_seen(f"{moved.tilt_deg:.0f}, {moved.azimuth_deg:.0f}", cure.moved)


def _if_seen(cure: str, candidate: DesignCandidate) -> tuple[str, str]:
    return (cure, _number(candidate.sigma_mm)) if math.isfinite(candidate.sigma_mm) else ("none", "–")


def _number(value: float) -> str:
    return f"{value:.2g}" if math.isfinite(value) else "–"


def _whole(value: float) -> str:
    return f"{value:.0f}" if math.isfinite(value) else "–"
