"""The step that shifts the inputs to the time at which they act."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import NonNegativeFloat

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.logs.step import Step


@dataclass(frozen=True)
class InputDelay(Step):
    """Shift each input to the time at which it acts: u_i(t) becomes u_i(t - d_i).

    Args:
        delay: d, s, rounded to samples of a uniform clock; one, or one per input.
    """

    delay: NonNegativeFloat | Sequence[NonNegativeFloat]

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        step = recording.sample_time("InputDelay")
        lags = np.atleast_1d(np.round(np.asarray(self.delay) / step).astype(int))
        inputs = recording.u.shape[1]
        if len(lags) not in (1, inputs):
            raise LogError(f"InputDelay: {len(lags)} delays, expected one or {inputs}")
        lags = np.broadcast_to(lags, inputs)
        longest, samples = int(lags.max()), len(recording)
        if samples - longest < 2:
            raise LogError(f"{recording.place}: shorter than the input delay: drop the run")
        u = np.column_stack([recording.u[longest - k : samples - k, i] for i, k in enumerate(lags)])
        text = ", ".join(f"{lag} samples ({lag * step:.4g} s)" for lag in dict.fromkeys(lags))
        return [replace(recording.rows(slice(longest, None)), u=u)], f"u delayed by {text}"
