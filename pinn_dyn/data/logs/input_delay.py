"""The step that shifts the inputs to where they act."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pinn_dyn.data.logs.delay import DelayCurve, input_delays
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.logs.step import Step, sample_time

_SHOWN = 8  # points of a curve in the report


@dataclass(frozen=True)
class InputDelay(Step):
    """Shifts each input to where it acts: u_i(t) becomes u_i(t - d_i), on a uniform clock.

    A delay that is not given is found on the training runs from the equation of motion, see
    :func:`~pinn_dyn.data.logs.input_delays`. Where the data do not tell, nothing is shifted, and
    the report says why.

    Args:
        delay: d, s, rounded to whole samples; one, or one per input; None finds it.
        longest: longest delay that is tried, s.
        common: whether all inputs share one delay.
    """

    delay: float | Sequence[float] | None = None
    longest: float = 0.3
    common: bool = False

    def __post_init__(self) -> None:
        if (self.delay is not None and np.any(np.asarray(self.delay) < 0)) or not self.longest > 0:
            raise LogError(
                f"InputDelay: delay is {self.delay} s and longest {self.longest} s, expected 0 or "
                "more, and more than 0"
            )

    @property
    def learns(self) -> bool:
        return self.delay is None

    def fit(self, training: list[Recording]) -> Step:
        if self.delay is not None:
            return self
        step = sample_time(training[0], "InputDelay")
        long = [recording for recording in training if recording.duration > 2 * self.longest]
        if not long:
            raise LogError(
                f"InputDelay: no training run is longer than twice {self.longest} s, the longest "
                "delay to be tried: lower longest, or give delay"
            )
        curves = input_delays(long, longest=self.longest, common=self.common)
        delays = [round((curve.delay or 0.0) / step) * step for curve in curves]
        return _FoundDelay(delays, self.longest, self.common, tuple(curves))

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        assert self.delay is not None
        inputs = recording.u.shape[1]
        if np.ndim(self.delay) and np.size(self.delay) != inputs:
            raise LogError(
                f"InputDelay: delay has {np.size(self.delay)} entries, expected one, or one for "
                f"each of {inputs} inputs"
            )
        step = sample_time(recording, "InputDelay")
        lags = np.broadcast_to(np.round(np.asarray(self.delay) / step).astype(int), inputs)
        most = int(lags.max())
        if len(recording) - most < 2:
            raise LogError(
                f"{recording.place}: shorter than the input delay, {most * step:.4g} s: drop the "
                "run"
            )
        u = np.column_stack(
            [recording.u[most - lag : len(recording) - lag, i] for i, lag in enumerate(lags)]
        )
        every = lags[:1] if len(set(lags)) == 1 else lags
        shown = ", ".join(f"{lag} samples ({lag * step:.4g} s)" for lag in every)
        shifted = replace(recording.rows(slice(most, None)), u=u)
        return [shifted], f"u delayed by {shown}, {self._origin()}"

    def _origin(self) -> str:
        return "as given"

    def __str__(self) -> str:
        return f"InputDelay(delay={self.delay}, longest={self.longest}, common={self.common})"


@dataclass(frozen=True)
class _FoundDelay(InputDelay):
    """Delays that were found, with the curves behind them."""

    curves: tuple[DelayCurve, ...] = ()

    def losses(self, before: list[Recording], after: list[Recording]) -> list[str]:
        refused = [
            f"input {i + 1} is not shifted, {curve}"
            for i, curve in enumerate(self.curves)
            if curve.delay is None
        ]
        return super().losses(before, after) + refused

    def _origin(self) -> str:
        texts = []
        for i, curve in enumerate(self.curves[: 1 if self.common else None]):
            points = range(0, len(curve.candidates), -(-len(curve.candidates) // _SHOWN))
            line = ", ".join(
                f"{1e3 * curve.candidates[k]:.0f} ms {100 * curve.residual[k]:.2g} %"
                for k in points
            )
            texts.append(f"input {'all' if self.common else i + 1}: {curve}; unexplained at {line}")
        return "found on the training runs: " + "; ".join(texts)
