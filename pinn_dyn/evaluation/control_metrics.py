"""Metrics of closed loops."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple

import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.control.closed_loop import ClosedLoopRecord

# A coordinate whose step is below this part of the largest step has no overshoot.
_SMALL_STEP = 0.05
_SETTLED = 0.02  # part of the step

Limit = Tensor | Sequence[float] | float | None


class ClosedLoopMetrics(NamedTuple):
    """Tracking errors and input effort of K closed loops, with e(t) = q_ref(t) - q(t).

    Means are over the runs that were not stopped, and infinite if all were stopped. A worst or
    largest value is infinite if any run was stopped. The last sample of a held input does not
    count. Metrics with * need set points: constant references, and a step s = q_ref - q(0) != 0.

    Attributes:
        summary: metrics over all coordinates and inputs:

            - ``runs``, ``stopped``: number of runs, and of stopped runs;
            - ``rms_error``, ``mean_error``, ``max_error``: sqrt(mean e_i^2), mean and largest |e|;
            - ``step_error_after_<T>_s_...`` *: largest |e| / |s| from T on;
            - ``settling_time_...`` *: time after which |e| < 0.02 |s|, and
              ``never_settled``, the number of runs without it;
            - ``overshoot_...`` *: largest distance beyond the set point over the coordinate's step;
            - ``steady_state_error``, ``..._percent`` *: mean |e| and |e| / |s| of the last tenth;
            - ``input_rms``, ``input_peak``, ``input_square_integral`` (integral of |u|^2 over a
              run), ``input_variation_per_s`` (path length of u per second);
            - ``saturated_...``: control instants of all runs with an input at a limit;
            - ``solve_time_...``, ``missed_deadlines``, ``solver_failures``: of predictive control
              over all control instants; the largest time leaves out the first instant.
        coordinates: one row per coordinate: RMS and largest error, and overshoot *.
    """

    summary: dict[str, float]
    coordinates: pd.DataFrame


def closed_loop_metrics(
    record: ClosedLoopRecord,
    *,
    settled_after: float | None = None,
    u_low: Limit = None,
    u_high: Limit = None,
) -> ClosedLoopMetrics:
    """Return the metrics of K closed loops.

    Args:
        record: K runs of a control law, with at least two samples.
        settled_after: time from which the step error is taken, s; None leaves it out.
        u_low, u_high: limits of the inputs, one number or M; None for no limit.
    """
    runs = _Runs(stopped_runs(record))
    error = (record.reference.q - record.q).double()
    norm = error.norm(dim=-1)
    square = runs.mean(error.square().mean(dim=1))  # (N,)
    summary: dict[str, Any] = {
        "runs": len(runs.lost),
        "stopped": int(runs.lost.sum()),
        "rms_error": square.mean().sqrt(),
        "mean_error": runs.mean(norm.mean(dim=1)),
        "max_error": runs.marked(norm.amax(dim=1)).max(),
    }
    largest = runs.marked(error.abs().amax(dim=1)).amax(dim=0)
    coordinates = {"rms_error": square.sqrt(), "max_error": largest}
    t = record.t.double() - record.t[0].double()
    steady = norm[:, t >= 0.9 * t[-1]].mean(dim=1)
    step = _set_point_step(record)
    if step is None:
        summary["steady_state_error"] = runs.mean(steady)
    else:
        size = step.norm(dim=-1)
        summary |= _step_errors(runs, t, norm / size[:, None], settled_after)
        overshoot = _overshoot(runs, error, step)
        summary |= {
            "overshoot_mean_percent": overshoot[runs.counted].nanmean(),
            "overshoot_worst_percent": _nanmax(_nanmax(overshoot)),
            "steady_state_error": runs.mean(steady),
            "steady_state_error_percent": 100 * runs.mean(steady / size),
        }
        coordinates["overshoot_mean_percent"] = overshoot[runs.counted].nanmean(dim=0)
        coordinates["overshoot_worst_percent"] = _nanmax(overshoot)
    held = record.u[:, :-1].double()
    summary |= _input_effort(runs, t, held)
    if u_low is not None or u_high is not None:
        summary |= _saturation(held, u_low, u_high)
    if "solve_time" in record.diagnostics:
        summary |= _solver_times(record.diagnostics)
    table = pd.DataFrame({name: x.tolist() for name, x in coordinates.items()})
    table.insert(0, "coordinate", [f"q{i + 1}" for i in range(len(table))])
    numbers = {k: x.item() if isinstance(x, Tensor) else x for k, x in summary.items()}
    return ClosedLoopMetrics(numbers, table)


class _Runs:
    """Means over the runs that were not stopped; over all if all were stopped."""

    def __init__(self, lost: Tensor):
        self.lost = lost
        self.counted = lost if lost.all() else ~lost

    def marked(self, values: Tensor) -> Tensor:
        """Return the values ``(K, ...)`` with infinity for the stopped runs."""
        return torch.where(self.lost.view(-1, *[1] * (values.ndim - 1)), torch.inf, values)

    def mean(self, values: Tensor) -> Tensor:
        """Return the mean of values ``(K, ...)`` over the runs."""
        return self.marked(values)[self.counted].mean(dim=0)


def _step_errors(
    runs: _Runs, t: Tensor, relative: Tensor, settled_after: float | None
) -> dict[str, Any]:
    """Return the times to settle, and errors relative to the step ``(K, T)`` from a time on."""
    errors: dict[str, Any] = {}
    if settled_after is not None:
        after = t >= settled_after - 1e-9 * t[-1]
        if after.any():
            percent = 100 * runs.marked(relative[:, after].amax(dim=1))
            name = f"step_error_after_{settled_after:g}_s"
            errors[f"{name}_mean_percent"] = runs.mean(percent)
            errors[f"{name}_worst_percent"] = percent.max()
    settling = runs.marked(_settling_times(relative, t))
    return errors | {
        "settling_time_median_s": median(settling.tolist()),
        "settling_time_worst_s": settling.max(),
        "never_settled": int(settling.isinf().sum()),
    }


def _overshoot(runs: _Runs, error: Tensor, step: Tensor) -> Tensor:
    """Return the distance beyond the set point in percent of the step, NaN for small steps."""
    beyond = (-error * step.sign()[:, None]).amax(dim=1).clamp(min=0)
    steps = step.abs()
    large = steps >= _SMALL_STEP * steps.amax(dim=1, keepdim=True)
    return torch.where(large, runs.marked(100 * beyond / steps), torch.nan)  # (K, N)


def _input_effort(runs: _Runs, t: Tensor, held: Tensor) -> dict[str, Any]:
    duration = float(t[-1])
    effort = (held.square() * t.diff()[:, None]).sum(dim=1)  # (K, M)
    return {
        "input_rms": (runs.mean(effort).mean() / duration).sqrt(),
        "input_peak": runs.marked(held.abs().amax(dim=(1, 2)))[runs.counted].max(),
        "input_square_integral": runs.mean(effort.sum(dim=-1)),
        "input_variation_per_s": runs.mean(held.diff(dim=1).norm(dim=-1).sum(dim=1) / duration),
    }


def _saturation(held: Tensor, u_low: Limit, u_high: Limit) -> dict[str, Any]:
    low = torch.as_tensor(-math.inf if u_low is None else u_low, dtype=held.dtype)
    high = torch.as_tensor(math.inf if u_high is None else u_high, dtype=held.dtype)
    saturated = int(((held <= low) | (held >= high)).any(dim=-1).sum())
    applied = int(torch.isfinite(held).all(dim=-1).sum())
    percent = 100 * saturated / max(applied, 1)
    return {"saturated_samples": saturated, "saturated_percent": percent}


def _solver_times(diagnostics: Mapping[str, Tensor]) -> dict[str, Any]:
    names = ("solve_time", "missed_deadline", "solver_failed")
    times, missed, failed = (diagnostics[x].double().nan_to_num(0.0) for x in names)
    return {
        "solve_time_median_ms": 1e3 * diagnostics["solve_time"].double().nanmedian(),
        "solve_time_largest_ms": 1e3 * times[:, 1:].max(),
        "missed_deadlines": int(missed.sum()),
        "solver_failures": int(failed.sum()),
    }


def stopped_runs(record: ClosedLoopRecord) -> Tensor:
    """Return which runs were stopped or have a q that is not finite, ``(K,)``, bool."""
    stopped = torch.tensor([reason is not None for reason in record.stopped])
    return stopped | ~torch.isfinite(record.q).all(dim=(1, 2))


def samples_before_stop(record: ClosedLoopRecord, run: int) -> int:
    """Return the number of samples of a run before its first q that is not finite."""
    return int(torch.isfinite(record.q[run]).all(dim=-1).int().cumprod(0).sum())


def _set_point_step(record: ClosedLoopRecord) -> Tensor | None:
    """Return q_ref - q(0), ``(K, N)``; None unless all references are set points off q(0)."""
    q_ref = record.reference.q.double()
    first = q_ref[:, :1]
    change = (q_ref - first).abs().nan_to_num(0.0)  # NaN after a stop
    step = first[:, 0] - record.q[:, 0].double()
    if (change > 1e-9 * (1 + first.abs())).any() or (step.norm(dim=-1) == 0).any():
        return None
    return step


def _settling_times(relative: Tensor, t: Tensor) -> Tensor:
    last = torch.where(~(relative <= _SETTLED), torch.arange(len(t)), -1).amax(dim=1)
    return torch.cat([t, t.new_full((1,), math.inf)])[last + 1]


def _nanmax(values: Tensor) -> Tensor:
    largest = values.nan_to_num(-1.0, posinf=math.inf).amax(dim=0)
    return torch.where(values.isnan().all(dim=0), torch.nan, largest)
