"""Advice about logs: the steps that a message names repair the log that failed."""

import re

import numpy as np
import pandas as pd
import pytest

from pinn_dyn.data import logs
from pinn_dyn.data.logs import LogError, LogSource


def table(clock=None):
    t = np.arange(1200) * 0.01 if clock is None else clock
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    return pd.DataFrame({"t": t, "q": q, "u": np.cos(3 * t)})


def clock(change):
    t = np.arange(1200) * 0.01
    change(t)
    return t


def repeat(t):
    t[400] = t[399]


def gap(t):
    t[400:] += 3.0


def jitter(t):
    t += 0.002 * np.sin(np.arange(len(t)) * 1.7)


RESAMPLE = logs.Resample(rate=100.0, max_gap=0.05)
CASES = {
    "repeated stamp": (table(clock(repeat)), {}),
    "repeated stamp, resampled": (table(clock(repeat)), {"resample": RESAMPLE}),
    "gap, resampled": (table(clock(gap)), {"resample": RESAMPLE}),
    "unsteady clock": (table(clock(jitter)), {}),
}
STEPS = {
    "Resample": RESAMPLE,
    "Deduplicate": logs.Deduplicate(),
    "SplitGaps": logs.SplitGaps(longest=0.05),
}


def load(frame, steps):
    return LogSource(
        name="joint",
        files=frame,
        time={"columns": "t", "unit": "s"},
        q={"columns": ["q"], "unit": "rad"},
        u={"columns": ["u"], "unit": "Nm"},
        validation={"seconds": 1.0, "piece": 0.5},
        test={"seconds": 1.0, "piece": 0.5},
        steps=steps,
    ).load()


@pytest.mark.parametrize("name", CASES)
def test_the_suggested_steps_repair_the_log(name):
    frame, steps = CASES[name]
    messages = set()
    while True:  # a repaired log may have a second problem
        try:
            assert load(frame, steps).train
            break
        except LogError as error:
            message = str(error)
        assert message not in messages, message
        messages.add(message)
        step = re.search(r"(?:put|add) an? (\w+) step|put (\w+) before", message)
        assert step, message
        key = step[1] or step[2]
        steps = {key: STEPS[key], **steps}
    assert messages
