"""The step that shifts the inputs to the time at which they act."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from pinn_dyn.data.logs.delay import DelayCurve, input_delays
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.logs.step import Step


@dataclass(frozen=True)
class InputDelay(Step):
    """Shift each input to the time at which it acts: u_i(t) becomes u_i(t - d_i).

    Without ``delay`` it is estimated on the training runs from the equation of motion, see
    :func:`~pinn_dyn.data.logs.input_delays`. Where the data do not determine the delay, nothing is
    shifted, and the report says why. The clock must be uniform.

    Args:
        delay: d, s, rounded to samples; one, or one per input; None estimates it.
        longest: longest delay that is tried, s.
        common: estimate one delay for all inputs.
    """

    delay: NonNegativeFloat | Sequence[NonNegativeFloat] | None = None
    longest: PositiveFloat = 0.3
    common: bool = False

    @property
    def learns(self) -> bool:
        return self.delay is None

    def fit(self, training: list[Recording]) -> Step:
        if self.delay is not None:
            return self
        step = training[0].sample_time("InputDelay")
        long = [recording for recording in training if recording.duration > 2 * self.longest]
        if not long:
            raise LogError(
                f"InputDelay: no training run is longer than twice {self.longest} s, the longest "
                "delay to be tried: lower longest, or give delay"
            )
        curves = input_delays(long, longest=self.longest, common=self.common)
        delays = [round((curve.delay or 0.0) / step) * step for curve in curves]
        return _EstimatedDelay(delays, self.longest, self.common, curves=tuple(curves))

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        assert self.delay is not None
        inputs = recording.u.shape[1]
        if np.ndim(self.delay) and np.size(self.delay) != inputs:
            raise LogError(
                f"InputDelay: delay has {np.size(self.delay)} entries, expected one, or one for "
                f"each of {inputs} inputs"
            )
        step = recording.sample_time("InputDelay")
        lags = np.broadcast_to(np.round(np.asarray(self.delay) / step).astype(int), inputs)
        longest = int(lags.max())
        if len(recording) - longest < 2:
            raise LogError(
                f"{recording.place}: shorter than the input delay, {longest * step:.4g} s: drop "
                "the run"
            )
        u = np.column_stack(
            [recording.u[longest - lag : len(recording) - lag, i] for i, lag in enumerate(lags)]
        )
        shown = lags[:1] if len(set(lags)) == 1 else lags
        text = ", ".join(f"{lag} samples ({lag * step:.4g} s)" for lag in shown)
        shifted = replace(recording.rows(slice(longest, None)), u=u)
        return [shifted], f"u delayed by {text}, {self._origin()}"

    def _origin(self) -> str:
        return "as configured"


@dataclass(frozen=True)
class _EstimatedDelay(InputDelay):
    """Delays that were estimated, with their curves."""

    curves: tuple[DelayCurve, ...] = field(default=(), repr=False)

    def losses(self, before: list[Recording], after: list[Recording]) -> list[str]:
        warnings = super().losses(before, after)
        for i, curve in enumerate(self.curves):
            if curve.delay is None:
                warnings.append(f"input {i + 1} is not shifted, {curve}")
        return warnings

    def _origin(self) -> str:
        texts = [
            f"input {'all' if self.common else i + 1}: {curve}"
            for i, curve in enumerate(self.curves[: 1 if self.common else None])
        ]
        return "estimated on the training runs: " + "; ".join(texts)
