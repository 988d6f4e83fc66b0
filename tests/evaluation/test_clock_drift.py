"""A clock of the inputs that runs slow, so that no input is logged at the end of a run."""

import numpy as np
import pandas as pd

from pinn_dyn.data.logs import LogSource
from pinn_dyn.log_check.check import check


def test_the_end_of_a_run_without_inputs_does_not_hide_a_clock_that_drifts():
    """A mass on a spring, whose largest force acts after the last time of the input's clock."""
    t = np.arange(0, 20, 0.01)
    drift = 0.04
    frames = {}
    for k in range(4):
        rng = np.random.default_rng(k)
        w, height, phase = rng.uniform(2, 9, 5), rng.uniform(0.2, 1, 5), rng.uniform(0, 6, 5)
        swell = 1 + 30 * np.exp(-(((t - 20) / 0.5) ** 2))  # the force is largest at the end

        def at(s, order, w=w, height=height, phase=phase):
            return (height * w**order * np.sin(np.outer(s, w) + phase + order * np.pi / 2)).sum(1)

        q = at(t, 0) * swell
        v = np.gradient(q, t)
        force = 2 * np.gradient(v, t) + 0.5 * v + 10 * q
        frames[f"run{k}"] = pd.DataFrame(
            {"t": t, "q": q, "v": v, "u": np.interp(t * (1 - drift), t, force)}
        )
    columns = {
        x: {"columns": [x], "unit": y} for x, y in zip("qvu", ("m", "m/s", "N"), strict=True)
    }
    parts = {k: {"runs": [x], "piece": 5.0} for k, x in (("validation", "run2"), ("test", "run3"))}
    report = check(LogSource(files=frames, time="t", **columns, **parts))
    (drifting,) = (x for x in report.measurements if x.name == "clock drift [%]")
    assert drifting.verdict == "warning"
    assert abs(drifting.value - 100 * drift / (1 - drift)) < 0.6
