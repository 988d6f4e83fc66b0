"""Metrics of closed loops."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple

import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.control.record import ClosedLoopRecord

SMALL_STEP = 0.05
"""A coordinate whose step is smaller than this part of the largest step has no overshoot."""

STEADY_PART = 0.1
"""The steady state is the last tenth of a run."""

Limit = Tensor | Sequence[float] | float | None


class ClosedLoopMetrics(NamedTuple):
    """Tracking errors and input effort of K closed loops, with e(t) = q_ref(t) - q(t).

    Means are over the runs that were not stopped, and infinite if all were stopped. A worst or
    largest value is infinite if any run was stopped. RMS values are over times, runs and the N
    coordinates; e is in the units of q. The input is constant between two control instants, so its
    last sample has no effect and does not count.

    The metrics marked with * exist only for set points: each reference is constant, and no run
    starts at its reference. The step is s = q_ref - q(0).

    Attributes:
        summary: metrics over all coordinates and inputs:

            - ``runs``, ``stopped``: number of runs, and of stopped runs.
            - ``rms_error``, ``mean_error``, ``max_error``: sqrt(mean e_i^2), mean and largest
              |e|_2.
            - ``step_error_after_<T>_s_mean_percent``, ``..._worst_percent`` *: see
              :func:`step_error_after`.
            - ``settling_time_median_s``, ``settling_time_worst_s`` *: first time from which |e|_2
              stays below ``settle_fraction`` |s|_2, and ``never_settled``, the number of runs that
              never settle, stopped runs among them.
            - ``overshoot_mean_percent``, ``overshoot_worst_percent`` *: largest distance beyond the
              set point, relative to the step of the coordinate.
            - ``steady_state_error``: mean |e|_2 over the last tenth of the runs, and
              ``steady_state_error_percent`` *, relative to |s|_2.
            - ``input_rms``, ``input_peak``, ``input_square_integral`` (integral of |u|^2 over a
              run), ``input_variation_per_s`` (path length of u per second).
            - ``saturated_samples``, ``saturated_percent``: control instants of all runs at which
              an input reaches a limit; absent without limits.
        coordinates: one row per coordinate: RMS and largest error, and overshoot *.
        inputs: one row per input: RMS, peak and integral of the square.
    """

    summary: dict[str, float]
    coordinates: pd.DataFrame
    inputs: pd.DataFrame


def closed_loop_metrics(
    record: ClosedLoopRecord,
    *,
    settle_fraction: float = 0.02,
    settled_after: float | None = None,
    u_low: Limit = None,
    u_high: Limit = None,
) -> ClosedLoopMetrics:
    """Return the metrics of K closed loops.

    Args:
        record: K runs of a control law, with at least two samples.
        settle_fraction: part of the step within which the error has settled.
        settled_after: time from which the step error is taken, s; None leaves the step error out.
        u_low, u_high: limits of the inputs, one number or M; None for no limit.

    Raises:
        ValueError: if ``settled_after`` is given and there is no step or no sample after it.
    """
    t = record.t.double() - record.t[0].double()
    duration = float(t[-1])
    lost = stopped_runs(record)
    error = (record.reference.q - record.q).double()
    norm = error.norm(dim=-1)
    square = error.square().mean(dim=1)  # (K, N)
    steady = norm[:, t >= (1 - STEADY_PART) * duration].mean(dim=1)
    summary: dict[str, Any] = {
        "runs": len(lost),
        "stopped": int(lost.sum()),
        "rms_error": _mean(square, lost).mean().sqrt(),
        "mean_error": _mean(norm.mean(dim=1), lost),
        "max_error": _marked(norm.amax(dim=1), lost).max(),
    }
    coordinates = {
        "rms_error": _mean(square, lost).sqrt(),
        "max_error": _marked(error.abs().amax(dim=1), lost).amax(dim=0),
    }
    if settled_after is not None:
        ratio = 100 * step_error_after(record, settled_after)
        name = f"step_error_after_{settled_after:g}_s"
        summary[f"{name}_mean_percent"] = _mean(ratio, lost)
        summary[f"{name}_worst_percent"] = ratio.max()
    step = _step(record)
    if step is not None:
        settling = _marked(_settling_times(norm, t, settle_fraction * step.norm(dim=-1)), lost)
        overshoot = _overshoot(error, step, lost)
        complete = overshoot if lost.all() else overshoot[~lost]
        summary |= {
            "settling_time_median_s": median(settling.tolist()),
            "settling_time_worst_s": settling.max(),
            "never_settled": int(settling.isinf().sum()),
            "overshoot_mean_percent": complete.nanmean(),
            "overshoot_worst_percent": _nanmax(_nanmax(overshoot)),
        }
        coordinates["overshoot_mean_percent"] = complete.nanmean(dim=0)
        coordinates["overshoot_worst_percent"] = _nanmax(overshoot)
    summary["steady_state_error"] = _mean(steady, lost)
    if step is not None:
        summary["steady_state_error_percent"] = 100 * _mean(steady / step.norm(dim=-1), lost)

    held = record.u[:, :-1].double()
    effort = (held.square() * t.diff()[:, None]).sum(dim=1)  # (K, M)
    summary |= {
        "input_rms": (_mean(effort, lost).mean() / duration).sqrt(),
        "input_peak": _largest(held.abs().amax(dim=(1, 2)), lost),
        "input_square_integral": _mean(effort.sum(dim=-1), lost),
        "input_variation_per_s": _mean(held.diff(dim=1).norm(dim=-1).sum(dim=1) / duration, lost),
    }
    if u_low is not None or u_high is not None:
        saturated = _saturated(held, u_low, u_high)
        applied = int(torch.isfinite(held).all(dim=-1).sum())
        summary["saturated_samples"] = saturated
        summary["saturated_percent"] = 100 * saturated / max(applied, 1)
    inputs = {
        "rms": (_mean(effort, lost) / duration).sqrt(),
        "peak": _largest(held.abs().amax(dim=1), lost),
        "square_integral": _mean(effort, lost),
    }
    return ClosedLoopMetrics(
        {k: x.item() if isinstance(x, Tensor) else x for k, x in summary.items()},
        _numbered("coordinate", "q", coordinates),
        _numbered("input", "u", inputs),
    )


def step_error_after(record: ClosedLoopRecord, seconds: float) -> Tensor:
    """Return max over t >= seconds of |e(t)|_2 / |s|_2 with the step s = q_ref - q(0), ``(K,)``.

    The result is infinite for a stopped run. The paper reports that its controller is below 0.0023
    within one second (section on the two-segment soft manipulator).

    Raises:
        ValueError: if the references are no set points, or if the runs do not last that long.
    """
    step = _step(record)
    if step is None:
        raise ValueError(
            "settled_after needs a step: references that are constant in time and differ from q(0) "
            "in every run; leave settled_after out"
        )
    t = record.t.double() - record.t[0].double()
    after = t >= seconds - 1e-9 * float(t[-1])
    if not after.any():
        raise ValueError(f"settled_after is {seconds} s, expected at most {float(t[-1]):g} s")
    error = (record.reference.q - record.q).double()[:, after].norm(dim=-1).amax(dim=1)
    return _marked(error / step.norm(dim=-1), stopped_runs(record))


def stopped_runs(record: ClosedLoopRecord) -> Tensor:
    """Return which runs were stopped or have a q that is not finite, ``(K,)``, bool."""
    stopped = torch.tensor([reason is not None for reason in record.stopped])
    return stopped | ~torch.isfinite(record.q).all(dim=(1, 2))


def samples_before_stop(record: ClosedLoopRecord, run: int) -> int:
    """Return the number of samples of a run before its first q that is not finite."""
    finite = torch.isfinite(record.q[run]).all(dim=-1)
    return len(finite) if finite.all() else int((~finite).int().argmax())


def comparison_table(results: Mapping[str, ClosedLoopMetrics]) -> pd.DataFrame:
    """Return one row per control law; errors are in the units of q, inputs in the units of u."""
    return pd.DataFrame([{"controller": name} | m.summary for name, m in results.items()])


def _step(record: ClosedLoopRecord) -> Tensor | None:
    """Return q_ref - q(0), ``(K, N)``; None unless all references are set points off q(0)."""
    q_ref = record.reference.q.double()
    first = q_ref[:, :1]
    change = (q_ref - first).abs().nan_to_num(0.0)  # NaN after a stop
    step = first[:, 0] - record.q[:, 0].double()
    if (change > 1e-9 * (1 + first.abs())).any() or (step.norm(dim=-1) == 0).any():
        return None
    return step


def _settling_times(norm: Tensor, t: Tensor, bound: Tensor) -> Tensor:
    """Return the time after the last sample outside the bound; infinite if that is the end."""
    outside = ~(norm <= bound[:, None])
    last = torch.where(outside, torch.arange(len(t)), -1).amax(dim=1)
    return torch.cat([t, t.new_full((1,), math.inf)])[last + 1]


def _overshoot(error: Tensor, step: Tensor, lost: Tensor) -> Tensor:
    """Return the overshoot in % of the step, ``(K, N)``; NaN for a coordinate with a small step."""
    size = step.abs()
    beyond = (-error * step.sign()[:, None]).amax(dim=1).clamp(min=0)
    counted = size >= SMALL_STEP * size.amax(dim=1, keepdim=True)
    return torch.where(counted, _marked(100 * beyond / size, lost), torch.nan)


def _nanmax(values: Tensor) -> Tensor:
    """Return the largest value over the first dimension; NaN only where all values are NaN."""
    largest = values.nan_to_num(-1.0, posinf=math.inf).amax(dim=0)
    return torch.where(values.isnan().all(dim=0), torch.nan, largest)


def _saturated(held: Tensor, low: Limit, high: Limit) -> int:
    """Return the number of instants at which any input reaches a limit."""
    at_limit = torch.zeros_like(held, dtype=torch.bool)
    for limit, sign in ((low, -1.0), (high, 1.0)):
        if limit is not None:
            at_limit |= sign * held >= sign * torch.as_tensor(limit, dtype=held.dtype)
    return int(at_limit.any(dim=-1).sum())


def _marked(values: Tensor, lost: Tensor) -> Tensor:
    """Return the values ``(K, ...)`` with infinity for the stopped runs."""
    return torch.where(lost.view(-1, *[1] * (values.ndim - 1)), torch.inf, values)


def _mean(values: Tensor, lost: Tensor) -> Tensor:
    """Return the mean over the complete runs; infinite without any."""
    return _marked(values, lost).mean(dim=0) if lost.all() else values[~lost].mean(dim=0)


def _largest(values: Tensor, lost: Tensor) -> Tensor:
    """Return the largest value over the complete runs; infinite without any."""
    return (_marked(values, lost) if lost.all() else values[~lost]).amax(dim=0)


def _numbered(kind: str, letter: str, columns: Mapping[str, Tensor]) -> pd.DataFrame:
    """Return a table with one numbered row per entry of the columns."""
    count = len(next(iter(columns.values())))
    table = {kind: [f"{letter}{i + 1}" for i in range(count)]}
    return pd.DataFrame(table | {name: x.tolist() for name, x in columns.items()})
