"""Numbers of a log check: noise, share of the inputs, bandwidth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pinn_dyn.data.logs import DelayCurve, Recording
from pinn_dyn.data.logs.check.averages import Averages
from pinn_dyn.data.logs.check.equation import EquationOfMotionRegression
from pinn_dyn.data.logs.check.input_faults import delayed

_LAGS = 30  # of a target that are tried
_STILL = 0.01  # variance of a coordinate at rest as a share of the largest
_INDEPENDENT = 3.5  # widths at which the averages of two rows are independent


def explained_share(
    training: Sequence[Recording], delays: Sequence[DelayCurve], step: float
) -> float:
    """Return the largest share of v and a that delayed inputs explain beside (1, q, v).

    The result is 1 where the rows are too few to tell.
    """
    parts = delayed(training, [curve.delay or 0.0 for curve in delays])
    data = Averages.of(parts, step, spacing=_INDEPENDENT)
    if data is None or len(data.t) < 6 * (3 * data.q.shape[1] + len(delays)):
        return 1.0
    u = data.u[:, 0]
    columns = {"one": np.ones((len(u), 1)), "u": u - u.mean(axis=0), "q": data.q}
    columns |= {"sin": np.sin(data.q), "cos": np.cos(data.q)}
    columns |= {"v": data.v - data.v.mean(axis=0), "a": data.a - data.a.mean(axis=0)}
    regression = EquationOfMotionRegression(columns, np.zeros(len(u), dtype=int))

    def unexplained(y: str, *x: str) -> float:
        """Return the share of the variance of y that x leaves, per degree of freedom."""
        names = ["one", "q", "sin", "cos", *x]
        count = sum(columns[name].shape[1] for name in names)
        return float(regression.fit(y, names).shares()[0].mean()) * len(u) / (len(u) - count)

    return max(
        unexplained("v") - unexplained("v", "u"),
        unexplained("a", "v") - unexplained("a", "v", "u"),
        # The acceleration of a controlled robot may follow from q and v; its torque then does too.
        1 - unexplained("u", "v", "a"),
    )


def target_distance(training: Sequence[Recording], step: float, longest: float) -> float:
    """Return the share of the variance of q that delayed targets u do not explain.

    The delay of each coordinate is the best one up to ``longest``, s. A constant offset between
    target and q does not count. The result is that of the worst coordinate.
    """
    size = training[0].q.shape[1]
    if training[0].u.shape[1] not in (size, 2 * size):
        return np.inf
    spread = np.vstack([item.q for item in training]).var(axis=0)
    spread = spread.clip(min=max(_STILL * spread.max(), 1e-300))
    lags = range(0, round(longest / step) + 1, max(round(longest / step / _LAGS), 1))
    shares = []
    for lag in lags:
        parts = [item.q[lag:] - item.u[: len(item) - lag, :size] for item in training]
        shares.append(np.vstack(parts).var(axis=0) / spread)
    return float(np.min(shares, axis=0).max())
