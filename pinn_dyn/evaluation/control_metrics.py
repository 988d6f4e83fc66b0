"""Figures of closed loops: every number about control quality is computed here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.control.record import ClosedLoopRecord

SMALL_STEP = 0.05
"""Overshoot is not asked of a coordinate that steps by less than this part of the largest step."""

STEADY_PART = 0.1
"""The steady state is the last tenth of a run."""


@dataclass(frozen=True)
class ClosedLoopMetrics:
    """How well and at what cost K closed loops follow their references, e(t) = q_ref(t) - q(t).

    Figures are over the runs that went to their end, as roll-out errors leave out what diverged;
    they are infinite if none did, never NaN. What is called worst or max is infinite if any run
    was stopped. Counts are over all runs. RMS is over times, runs and coordinates, N of them; e is
    in the units of q, where rad and m are mixed if q mixes them. The input is held between control
    instants, so its last sample, which nothing obeys, does not count.

    A record is of set points if each reference is constant and no run starts at its own. With the
    step s = q_ref - q(0) and its size RMS(s), over the coordinates, only then it has the figures
    that are None otherwise.

    Attributes:
        runs: K.
        stopped: how many of them were stopped before their end.
        duration: length of the runs, s.
        set_points: whether the references are set points.
        rms_error: sqrt(mean e_i^2).
        mean_error: mean of |e|_2.
        max_error: largest |e|_2.
        worst_run: index of the run with the largest RMS error, the first stopped one if any.
        step_error_after: the time in s that the two next figures are for, None if not asked for.
        step_error_mean, step_error_worst: see :func:`step_error_after`, %, over runs.
        settling_time_median, settling_time_worst: first time in s, to a sample, from which on
            |e|_2 stays below ``settle_fraction`` |s|_2; infinite for a run that never settles or
            was stopped, and the median is over all runs.
        never_settled: how many runs never settle, the stopped ones among them.
        overshoot_mean, overshoot_worst: how far a coordinate goes beyond its set point, in % of
            its own step, over runs and coordinates; coordinates whose step is below 5 % of the
            largest in the run are left out.
        steady_state_error: mean of |e|_2 over the last tenth of the runs.
        steady_state_error_relative: the same in % of |s|_2.
        input_rms: sqrt(mean u_i^2), over inputs too; in the units of u.
        input_peak: largest |u_i|.
        input_square_integral: integral of |u|^2 over a run, mean over runs.
        input_variation: path length of u per second, sum_k |u_k+1 - u_k|_2 / duration.
        saturated_samples: at how many control instants any input is at a limit or beyond it, all
            runs together; None without limits.
        saturated_part: the same in % of the instants.
        rms_error_of, max_error_of: RMS and largest |e_i| of each coordinate, N.
        overshoot_mean_of, overshoot_worst_of: overshoot of each coordinate, %, N; NaN for one
            that is always left out.
        input_rms_of, input_peak_of, input_square_integral_of: of each input, M.
    """

    runs: int
    stopped: int
    duration: float
    set_points: bool
    rms_error: float
    mean_error: float
    max_error: float
    worst_run: int
    step_error_after: float | None
    step_error_mean: float | None
    step_error_worst: float | None
    settling_time_median: float | None
    settling_time_worst: float | None
    never_settled: int | None
    overshoot_mean: float | None
    overshoot_worst: float | None
    steady_state_error: float
    steady_state_error_relative: float | None
    input_rms: float
    input_peak: float
    input_square_integral: float
    input_variation: float
    saturated_samples: int | None
    saturated_part: float | None
    rms_error_of: tuple[float, ...]
    max_error_of: tuple[float, ...]
    overshoot_mean_of: tuple[float, ...] | None
    overshoot_worst_of: tuple[float, ...] | None
    input_rms_of: tuple[float, ...]
    input_peak_of: tuple[float, ...]
    input_square_integral_of: tuple[float, ...]

    def to_dict(self) -> dict[str, float]:
        """The row of a table: scalars under names that say their unit, without what is None."""
        after = f"step_error_after_{self.step_error_after or 0:g}_s"
        row: dict[str, float | None] = {
            "runs": self.runs,
            "stopped": self.stopped,
            "rms_error": self.rms_error,
            "mean_error": self.mean_error,
            "max_error": self.max_error,
            f"{after}_mean_percent": self.step_error_mean,
            f"{after}_worst_percent": self.step_error_worst,
            "settling_time_median_s": self.settling_time_median,
            "settling_time_worst_s": self.settling_time_worst,
            "never_settled": self.never_settled,
            "overshoot_mean_percent": self.overshoot_mean,
            "overshoot_worst_percent": self.overshoot_worst,
            "steady_state_error": self.steady_state_error,
            "steady_state_error_percent": self.steady_state_error_relative,
            "input_rms": self.input_rms,
            "input_peak": self.input_peak,
            "input_square_integral": self.input_square_integral,
            "input_variation_per_s": self.input_variation,
            "saturated_samples": self.saturated_samples,
            "saturated_percent": self.saturated_part,
        }
        return {name: value for name, value in row.items() if value is not None}

    def per_coordinate(self) -> pd.DataFrame:
        """One row per coordinate: RMS and largest error, and overshoot for set points."""
        columns = {"rms_error": self.rms_error_of, "max_error": self.max_error_of}
        if self.overshoot_mean_of is not None and self.overshoot_worst_of is not None:
            columns["overshoot_mean_percent"] = self.overshoot_mean_of
            columns["overshoot_worst_percent"] = self.overshoot_worst_of
        return _numbered("coordinate", "q", columns)

    def per_input(self) -> pd.DataFrame:
        """One row per input: RMS, peak and integral of the square."""
        columns = {
            "rms": self.input_rms_of,
            "peak": self.input_peak_of,
            "square_integral": self.input_square_integral_of,
        }
        return _numbered("input", "u", columns)


def closed_loop_metrics(
    record: ClosedLoopRecord,
    *,
    settle_fraction: float = 0.02,
    settled_after: float | None = None,
    u_low: Tensor | Sequence[float] | float | None = None,
    u_high: Tensor | Sequence[float] | float | None = None,
) -> ClosedLoopMetrics:
    """Figures of K closed loops.

    Args:
        record: what the loop left behind.
        settle_fraction: part of the step within which the error has settled.
        settled_after: time in s from which on the step error is judged; None leaves it out.
        u_low, u_high: limits of the inputs, one number or M; None for no limit on that side.

    Raises:
        ValueError: on fewer than two samples, a settle_fraction outside (0, 1), limits that do
            not fit the inputs, or a settled_after where there is no step or no sample.
    """
    if record.t.shape[0] < 2:
        raise ValueError(f"record has {record.t.shape[0]} samples, expected at least 2")
    if not 0 < settle_fraction < 1:
        raise ValueError(f"settle_fraction is {settle_fraction}, expected a part between 0 and 1")
    t = record.t.double() - record.t[0].double()
    duration = float(t[-1])
    lost = stopped_runs(record)
    error = (record.reference.q - record.q).double()
    norm = error.norm(dim=-1)
    square = error.square().mean(dim=1)  # (K, N)
    run_rms = _marked(square.mean(dim=1).sqrt(), lost)
    steady = norm[:, t >= (1 - STEADY_PART) * duration].mean(dim=1)

    held, times = record.u[:, :-1].double(), t.diff()
    effort = (held.square() * times[:, None]).sum(dim=1)  # (K, M)
    variation = held.diff(dim=1).norm(dim=-1).sum(dim=1) / duration
    saturated = _saturated(held, u_low, u_high)
    applied = int(torch.isfinite(held).all(dim=-1).sum())

    step = _step(record)
    settling = kept = mean_of = worst_of = None
    if step is not None:
        settling = _marked(_settling_times(norm, t, settle_fraction * step.norm(dim=-1)), lost)
        overshoot = _overshoot(error, step, lost)
        kept = overshoot if lost.all() else overshoot[~lost]
        mean_of, worst_of = kept.nanmean(dim=0), _nanmax(overshoot)
    after = None if settled_after is None else step_error_after(record, settled_after)
    return ClosedLoopMetrics(
        runs=len(lost),
        stopped=int(lost.sum()),
        duration=duration,
        set_points=step is not None,
        rms_error=_mean(square, lost).mean().sqrt().item(),
        mean_error=_mean(norm.mean(dim=1), lost).item(),
        max_error=_marked(norm.amax(dim=1), lost).max().item(),
        worst_run=int(run_rms.argmax()),
        step_error_after=settled_after,
        step_error_mean=None if after is None else 100 * _mean(after, lost).item(),
        step_error_worst=None if after is None else 100 * after.max().item(),
        settling_time_median=None if settling is None else median(settling.tolist()),
        settling_time_worst=None if settling is None else settling.max().item(),
        never_settled=None if settling is None else int(settling.isinf().sum()),
        overshoot_mean=None if kept is None else kept.nanmean().item(),
        overshoot_worst=None if worst_of is None else _nanmax(worst_of).item(),
        steady_state_error=_mean(steady, lost).item(),
        steady_state_error_relative=(
            None if step is None else 100 * _mean(steady / step.norm(dim=-1), lost).item()
        ),
        input_rms=(_mean(effort, lost).mean() / duration).sqrt().item(),
        input_peak=_largest(held.abs().amax(dim=(1, 2)), lost).item(),
        input_square_integral=_mean(effort.sum(dim=-1), lost).item(),
        input_variation=_mean(variation, lost).item(),
        saturated_samples=saturated,
        saturated_part=None if saturated is None else 100 * saturated / max(applied, 1),
        rms_error_of=tuple(_mean(square, lost).sqrt().tolist()),
        max_error_of=tuple(_marked(error.abs().amax(dim=1), lost).amax(dim=0).tolist()),
        overshoot_mean_of=None if mean_of is None else tuple(mean_of.tolist()),
        overshoot_worst_of=None if worst_of is None else tuple(worst_of.tolist()),
        input_rms_of=tuple((_mean(effort, lost) / duration).sqrt().tolist()),
        input_peak_of=tuple(_largest(held.abs().amax(dim=1), lost).tolist()),
        input_square_integral_of=tuple(_mean(effort, lost).tolist()),
    )


def step_error_after(record: ClosedLoopRecord, seconds: float) -> Tensor:
    """max over t >= seconds of RMS_i(e_i(t)) / RMS_i(s_i) with the step s = q_ref - q(0), ``(K,)``.

    RMS is over the coordinates; a stopped run has an infinite one. The paper reports that its
    controller is within one second below 0.0023 (section on the two-segment soft manipulator).

    Raises:
        ValueError: if the references are no set points, or if the runs do not last that long.
    """
    step = _step(record)
    if step is None:
        raise ValueError(
            "the record has no step to relate an error to: expected references that are constant "
            "in time and differ from q(0) in every run; leave settled_after out"
        )
    t = record.t.double() - record.t[0].double()
    late = t >= seconds - 1e-9 * float(t[-1])
    if seconds < 0 or not late.any():
        raise ValueError(
            f"settled_after is {seconds} s, expected between 0 and {float(t[-1]):g} s, as long as "
            "the runs last"
        )
    error = (record.reference.q - record.q).double()[:, late].norm(dim=-1).amax(dim=1)
    return _marked(error / step.norm(dim=-1), stopped_runs(record))


def stopped_runs(record: ClosedLoopRecord) -> Tensor:
    """Which runs did not go to their end, ``(K,)``, bool: stopped, or q not finite throughout."""
    stopped = torch.tensor([reason is not None for reason in record.stopped])
    return stopped | ~torch.isfinite(record.q).all(dim=(1, 2))


def samples_before_stop(record: ClosedLoopRecord, run: int) -> int:
    """How many samples of a run come before its first q that is not finite; all if none is.

    Raises:
        ValueError: if there is none.
    """
    alive = torch.isfinite(record.q[run]).all(dim=-1)
    if not alive[0]:
        raise ValueError(f"run {run} has no finite q at its start: expected one that started")
    return len(alive) if alive.all() else int((~alive).int().argmax())


def comparison_table(results: dict[str, ClosedLoopMetrics]) -> pd.DataFrame:
    """One row per controller; errors are in the units of q, inputs in the units of u.

    A figure that a controller has not, as its runs are no set points, is missing in its row.

    Raises:
        ValueError: on an empty dictionary.
    """
    if not results:
        raise ValueError("results is empty: expected at least one controller")
    return pd.DataFrame([{"controller": name} | m.to_dict() for name, m in results.items()])


def _step(record: ClosedLoopRecord) -> Tensor | None:
    """q_ref - q(0), ``(K, N)``, where all references are set points away from q(0)."""
    q_ref = record.reference.q.double()
    first = q_ref[:, :1]
    moved = (q_ref - first).abs().nan_to_num(0.0)  # NaN where a run has stopped
    step = first[:, 0] - record.q[:, 0].double()
    if (moved > 1e-9 * (1 + first.abs())).any() or (step.norm(dim=-1) == 0).any():
        return None
    return step


def _settling_times(norm: Tensor, t: Tensor, bound: Tensor) -> Tensor:
    outside = ~(norm <= bound[:, None])
    last = torch.where(outside, torch.arange(len(t)), -1).amax(dim=1)
    # One after the last sample outside; there is none if that is the last of all.
    return torch.cat([t, t.new_full((1,), math.inf)])[last + 1]


def _overshoot(error: Tensor, step: Tensor, lost: Tensor) -> Tensor:
    """In % of the step, ``(K, N)``; NaN for a coordinate that hardly steps."""
    size = step.abs()
    beyond = (-error * step.sign()[:, None]).amax(dim=1).clamp(min=0)
    counted = size >= SMALL_STEP * size.amax(dim=1, keepdim=True)
    return torch.where(counted, _marked(100 * beyond / size, lost), torch.nan)


def _nanmax(values: Tensor) -> Tensor:
    """Largest over the first dimension; NaN only where there is nothing else."""
    largest = values.nan_to_num(-1.0, posinf=math.inf).amax(dim=0)
    return torch.where(values.isnan().all(dim=0), torch.nan, largest)


def _saturated(
    held: Tensor,
    low: Tensor | Sequence[float] | float | None,
    high: Tensor | Sequence[float] | float | None,
) -> int | None:
    if low is None and high is None:
        return None
    at_limit = torch.zeros_like(held, dtype=torch.bool)
    for name, limit, sign in (("u_low", low, -1.0), ("u_high", high, 1.0)):
        if limit is None:
            continue
        value = torch.as_tensor(limit, dtype=held.dtype)
        if value.shape not in ((), held.shape[-1:]):
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}, expected one number or "
                f"{held.shape[-1]}, one for each input"
            )
        at_limit |= sign * held >= sign * value
    return int(at_limit.any(dim=-1).sum())


def _marked(values: Tensor, lost: Tensor) -> Tensor:
    """The values ``(K, ...)`` with infinity for the runs that were stopped."""
    return torch.where(lost.view(-1, *[1] * (values.ndim - 1)), torch.inf, values)


def _mean(values: Tensor, lost: Tensor) -> Tensor:
    """Mean over the runs that went to their end; infinite if none did."""
    return _marked(values, lost).mean(dim=0) if lost.all() else values[~lost].mean(dim=0)


def _largest(values: Tensor, lost: Tensor) -> Tensor:
    """Largest over the runs that went to their end; infinite if none did."""
    return (_marked(values, lost) if lost.all() else values[~lost]).amax(dim=0)


def _numbered(what: str, letter: str, columns: dict[str, tuple[float, ...]]) -> pd.DataFrame:
    count = len(next(iter(columns.values())))
    return pd.DataFrame({what: [f"{letter}{i + 1}" for i in range(count)], **columns})
