"""Low-pass filtered motion for identification by inverse dynamics."""

from __future__ import annotations

from collections.abc import Sequence

import scipy
import torch
from torch import Tensor

from pinn_dyn.mechanics import Trajectory


def filtered_motion(
    trajectories: Sequence[Trajectory], cutoff: float, samples: int
) -> list[Tensor]:
    """Return at most ``samples`` samples of q, v, a and u after a low-pass filter of ``cutoff`` Hz.

    The Butterworth filter of fourth order runs forwards and backwards. a is the derivative of the
    filtered v by differences of fourth order. Half a period of the cutoff is removed at both ends.

    Raises:
        ValueError: if the cutoff is above half the sample rate, or all trajectories are too short.
    """
    parts: list[list[Tensor]] = []
    for item in trajectories:
        rate = 1 / float(item.t[1] - item.t[0])
        if not cutoff < rate / 2:
            raise ValueError(
                f"least squares: cutoff is {cutoff} Hz, expected less than half the sample rate of "
                f"{rate:g} Hz"
            )
        if item.duration < 3 / cutoff:
            continue
        low_pass = scipy.signal.butter(4, cutoff, fs=rate, output="sos")
        smooth = [
            scipy.signal.sosfiltfilt(low_pass, getattr(item, name).numpy(), axis=0)
            for name in "qvu"
        ]
        q, v, u = (torch.from_numpy(x.copy()).double() for x in smooth)
        # Plain differences would lose 2 % of an acceleration at a twentieth of the sample rate.
        near, far = v.roll(-1, 0) - v.roll(1, 0), v.roll(-2, 0) - v.roll(2, 0)
        a = (8 * near - far) * rate / 12
        edge = max(int(0.5 * rate / cutoff), 2)
        parts.append([x[edge:-edge] for x in (q, v, a, u)])
    if not parts:
        longest = max(item.duration for item in trajectories)
        raise ValueError(
            f"least squares: the longest training trajectory has {longest:g} s, expected at least "
            f"three periods of the cutoff of {cutoff} Hz"
        )
    joined = [torch.cat(columns) for columns in zip(*parts, strict=True)]
    count = len(joined[0])
    index = torch.linspace(0, count - 1, min(samples, count)).long()
    return [x[index] for x in joined]
