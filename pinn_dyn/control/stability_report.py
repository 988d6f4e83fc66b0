"""The stability report in Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd
import torch
from torch import Tensor

MEASUREMENT_TOLERANCE = 1e-6
"""Excess of a measured error over its bound that does not count: simulations end early."""


def stability_report(
    title: str,
    conditions: pd.DataFrame,
    steady_states: pd.DataFrame | None = None,
    measured: Tensor | None = None,
    required_gains: Mapping[float, Tensor] | None = None,
) -> str:
    """Return Proposition 1 for one model in Markdown.

    Args:
        title: heading, which names the region and the gains.
        conditions: table of :func:`certify`.
        steady_states: table of :func:`predict_steady_state`.
        measured: |q - q_ref| at the end of the measured runs, ``(K,)``, NaN for a stopped run.
        required_gains: steady-state error and the K_P that each set point needs for it.
    """
    rows = []
    for name, key, good in (
        ("condition 1, eigenvalue of A A_L^T", "condition_1", conditions["condition_1"] > 0),
        ("eigenvalue of A A_L^T K_P", "position_eigenvalue", conditions["position_eigenvalue"] > 0),
        ("eigenvalue of A A_L^T K_D", "velocity_eigenvalue", conditions["velocity_eigenvalue"] > 0),
        ("condition 2, ‖A^-1 P^-1 (A_L - P A)‖", "condition_2", conditions["condition_2"] < 1),
        ("‖Delta_all‖ = ‖A A_L^-1 G_L - G‖", "delta_all", None),
        ("bound on ‖Delta_all‖ by P", "delta_all_bound", None),
        ("‖G‖, for comparison", "potential_force", None),
        ("distance from the set point at rest", "rest_error", None),
    ):
        worst = conditions[key].min() if "eigenvalue" in name else conditions[key].max()
        rows.append([name, conditions[key].median(), worst, "-" if good is None else _share(good)])
    coordinates = [name for name in conditions if name[:1] == "q"]
    farthest = conditions.nlargest(3, "rest_error")[[*coordinates, "rest_error"]]
    sections = [
        f"# {title}",
        f"Proposition 1 of the paper at {len(conditions)} configurations, and not between them. "
        "docs/stability.md explains the numbers. The eigenvalues must be positive, condition 2 "
        "below 1. P fits M, D, G and A together; with P = A_L A^-1, condition 2 is 0 everywhere.",
        _table(["", "median", "worst", "holds at"], rows),
        "Configurations with the largest `rest_error`, the distance from the set point at rest:",
        _table(list(farthest), farthest.to_numpy().tolist()),
    ]
    if steady_states is not None:
        sections += _steady_states(steady_states, measured)
    if required_gains:
        gains = [[error, k.median(), k.max()] for error, k in required_gains.items()]
        sections += [
            "## Gain for a desired steady-state error",
            "The smallest scalar K_P for which the bound is no larger, the κ of Proposition 1.",
            _table(["error", "K_P, median set point", "K_P, all set points"], gains),
        ]
    sections += [
        "## Limits of this report",
        "- L carries a margin, not a proof. The bound holds near the set point; the report does "
        "not show that the arm gets there from far away.\n"
        "- The law is in continuous time, without delay, noise or limits of the input, and the "
        "plant has no dry friction.",
    ]
    return "\n\n".join(sections) + "\n"


def _steady_states(table: pd.DataFrame, measured: Tensor | None) -> list[str]:
    error = pd.Series(torch.nan if measured is None else measured.numpy(), table.index)
    held = table.assign(measured=error)[table["holds"]]
    above = held["measured"] > held["bound"] + MEASUREMENT_TOLERANCE
    rows = [
        ["conditions hold", _share(table["holds"])],
        ["measured above the bound", f"{int(above.sum())} of {held['measured'].count()}"],
        ["slowest pole, 1/s", table["slowest_pole"].max()],
        ["control step below, s", 2 / table["fastest_pole"].max()],
    ]
    for name in ("bound", "error", "measured") if len(held) else ():
        text = f"{held[name].median():.3g} / {held[name].max():.3g}"
        rows.append([f"{name}, median / largest", text])
    return [
        "## Steady-state error",
        "‖q - q_ref‖ of the set points where the conditions hold: L < 1 and condition 1 in a ball "
        "around the set point, and all poles of the linearized loop on the left. A sampled "
        "controller needs at least a step below 2 / |fastest pole|. A run must last several times "
        "1 / |slowest pole| to reach its steady state.",
        _table(["", "value"], rows),
    ]


def _share(good: Tensor | pd.Series) -> str:
    return f"{int(good.sum())} of {len(good)}"


def _table(header: list[str], rows: list[list[Any]]) -> str:
    text = [[x if isinstance(x, str) else f"{float(x):.3g}" for x in row] for row in rows]
    lines = [header, ["---"] * len(header), *text]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
