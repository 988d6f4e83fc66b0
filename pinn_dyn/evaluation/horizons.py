"""How long and in which windows models are compared, where nobody says it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor

from pinn_dyn.mechanics import samples_of

LONGEST = 5.0
"""Length of a roll-out in s that is taken where the trajectories are longer."""

WINDOWS = (0.1, 0.5, 1.0)
"""Windows in s, of which those that fit are taken."""


def default_horizon(duration: float) -> float:
    """The whole trajectory, up to 5 s."""
    return min(duration, LONGEST)


def default_windows(horizon: float, grid: float) -> list[float]:
    """Those of 0.1, 0.5 and 1 s that are a multiple of the grid and shorter than the horizon.

    Where none is, the multiple of the grid next to a tenth of the horizon.

    Args:
        horizon: length of the roll-outs, s.
        grid: time between two compared samples, s.
    """
    fitting = [w for w in WINDOWS if w < 0.99 * horizon and _whole(w / grid)]
    tenth = max(1, round(horizon / 10 / grid)) * grid
    return fitting or ([tenth] if tenth < horizon else [])


def common_stride(steps: Sequence[float], t: Tensor) -> int:
    """Samples between the times that roll-outs of different steps have in common.

    Args:
        steps: step of each model, s.
        t: sample times of the data, ``(T,)``, s.

    Raises:
        ValueError: if a step is no multiple of the sample time, or the roll-outs have no time in
            common but their start.
    """
    stride = math.lcm(*(samples_of("step", step, t) for step in set(steps)))
    if stride > len(t) - 1:
        shown = ", ".join(f"{step:g}" for step in sorted(set(steps)))
        raise ValueError(
            f"models with steps of {shown} s have no time in common within {float(t[-1] - t[0]):g} "
            "s: evaluate them separately, or give those that take any a step that fits (step=...)"
        )
    return stride


def _whole(ratio: float) -> bool:
    return round(ratio) >= 1 and abs(ratio - round(ratio)) < 1e-3
