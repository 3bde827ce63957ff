"""Costs of the catalogue's effects to the seam of a planned cell, for JSON and as CSV."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from arctrack.plan.plan_files import Row, write_rows
from noise_model.compiled.arrays import Float64
from noise_model.even_sample import evenly
from noise_model.plan.path import Path
from noise_model.plan.plan import Plan
from sim_to_real.decision.setup_cost import PoseOfTool, SetupCost, setup_costs

COSTS = "costs.csv"

AFTER_S = (1.0, 2.0)
"""Times after a path's start at which effects are rendered, s: a drift or a tilt grows along the way.

There are two frames: each effect has some five sizes, and each takes 0.1 s a frame.
"""

TRAVEL_MM_S = 8.0
"""Speed along the nominal path, mm/s, which a plan does not know: that of `arctrack simulate`."""


def plan_costs(
    plan: Plan,
    recorded: tuple[PoseOfTool, Sequence[float]] | None,
    on_effect: Callable[[int, int], None],
) -> tuple[SetupCost, ...]:
    """Return the costs of all effects at stations of a plan's path that show the seam; none without any.

    `recorded` are the tool's poses by time, and times, s, of a recording; by default the tool goes along the
    nominal path at `TRAVEL_MM_S`.
    """
    if recorded is not None:
        pose_at, times_s = recorded
        # The ends of a run see the ends of a seam.
        inner = [times_s[n] for n in evenly(len(times_s), len(AFTER_S) + 2)[1:-1]]
        return setup_costs(plan.setup, pose_at, inner, times_s[0], on_effect) if inner else ()
    pose_at, times_s = along_path(plan.along.path, plan.along.column("sigma_mm"))
    if not times_s:
        return ()
    began_s, until_s = times_s[0], times_s[-1]
    after = [min(began_s + time_s, until_s) for time_s in AFTER_S]
    return setup_costs(plan.setup, pose_at, after, began_s, on_effect)


def along_path(path: Path, sigma_mm: Float64) -> tuple[PoseOfTool, list[float]]:
    """Return the tool's poses by time along a path at `TRAVEL_MM_S`, and the times, s, that show the seam.

    `sigma_mm` (n,) are the stations' sigmas, not finite where the seam does not show. Between stations the
    tool goes straight, turned as at the nearer one.
    """
    times_s = path.station_mm / TRAVEL_MM_S

    def pose_at(time_s: float) -> Float64:
        T_base_tool: Float64 = path.T_base_tool[int(np.argmin(np.abs(times_s - time_s)))].copy()
        T_base_tool[:3, 3] = [np.interp(time_s, times_s, axis) for axis in path.T_base_tool[:, :3, 3].T]
        return T_base_tool

    return pose_at, times_s[np.isfinite(sigma_mm)].tolist()


def cost_content(costs: Sequence[SetupCost]) -> list[dict[str, Any]]:
    """Return costs as JSON has them."""
    return [
        {**_numbers(each), "flag": _numbers(each)["flag"] or None, "parameters": each.cost.values}
        for each in costs
    ]


def write_costs(costs: Sequence[SetupCost], folder: FilePath) -> None:
    """Write costs.csv, all parameters in one cell; nothing without costs."""
    rows: list[Row] = [
        {**_numbers(each), "parameters": " ".join(f"{k}={v:g}" for k, v in each.cost.values.items())}
        for each in costs
    ]
    if rows:
        write_rows(folder / COSTS, rows)


def _numbers(each: SetupCost) -> Mapping[str, Any]:
    cost = each.cost
    return {
        "id": cost.id,
        "size": each.kind.value,
        "lateral_mm": cost.lateral_mm.value,
        "vertical_mm": cost.vertical_mm.value,
        "frames": cost.n_frames,
        "lost": cost.n_lost,
        "flag": "" if cost.flag is None else cost.flag.value,
    }
