"""Advice about logs: the steps that a message names repair the log that failed."""

import re

import numpy as np
import pandas as pd
import pytest
import yaml
from hydra.utils import instantiate
from scipy.ndimage import gaussian_filter1d

import pinn_dyn
from pinn_dyn.data import logs
from pinn_dyn.data.logs import LogError, LogSource


def table(clock=None):
    t = np.arange(1200) * 0.01 if clock is None else clock
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    return pd.DataFrame({"t": t, "q": q, "u": np.cos(3 * t)})


RESAMPLE = logs.Resample(rate=100.0, max_gap=0.05)
STEPS = {
    "Resample": RESAMPLE,
    "SplitGaps": logs.SplitGaps(longest=0.05),
}


def read(files, **changes):
    arguments = dict(
        name="joint",
        files=files,
        time={"columns": "t", "unit": "s"},
        q={"columns": ["q"], "unit": "rad"},
        u={"columns": ["u"], "unit": "Nm"},
        validation={"seconds": 1.0, "piece": 0.5},
        test={"seconds": 1.0, "piece": 0.5},
    )
    source = LogSource(**arguments | changes)
    assert source.load().train
    return source


def changed(**columns):
    return table().assign(**columns)


def spike(column):
    frame = table()
    frame.loc[[300, 700, 701], column] = 50.0
    return frame


def append(step):
    if step.startswith("pinn_dyn"):
        return {"steps": {"new": eval(step, {"pinn_dyn": pinn_dyn})}}
    return {"steps": {"new": instantiate(yaml.safe_load(step))}}


def runs(text):
    """Put a copy and its original, ``c repeat one of b``, into one split."""
    both = text.split(" repeat one of ")
    return {part: {"runs": x, "piece": 0.5} for part, x in (("test", both), ("validation", ["d"]))}


ALTERNATING = table()
ALTERNATING.loc[1::2, "q"] -= 2 * ALTERNATING.loc[1::2, "q"]
SLOW = {"a": table(), "b": table(), "c": table()[::2].reset_index(drop=True)}
NOISE = gaussian_filter1d(np.random.default_rng(0).normal(size=(4, 1200)), 8)
RANDOM = {name: table().assign(q=q) for name, q in zip("abcd", NOISE, strict=True)}
COPIED = RANDOM | {"c": RANDOM["b"]}
SPLIT = {part: {"runs": [run], "piece": 0.5} for part, run in (("test", "c"), ("validation", "b"))}
GAP = table(np.arange(1200) * 0.01 + 3.0 * (np.arange(1200) >= 400))
LONG = table().rename(columns={"q": "x", "u": "y"}).assign(joint="arm")
LONG = pd.concat([LONG, LONG.iloc[[50]]], ignore_index=True)
OF_LONG = {"long": "joint", "q": {"columns": "x/arm", "unit": "rad"}}
OF_LONG["u"] = {"columns": "y/arm", "unit": "Nm"}
WRAPPED = np.linspace(0, 30, 1200)
MEASURED = {"v": {"columns": "w", "unit": "rad/s"}, "steps": {"v": logs.SavitzkyGolayVelocity()}}
# Log, its description, the advice as a pattern, and the log and description that follow it.
ADVICE = {
    "wrapped angle": (
        changed(q=WRAPPED % (2 * np.pi)), {}, r"unwrap the column \(numpy.(\w+)\)",
        lambda name: (changed(q=getattr(np, name)(WRAPPED % (2 * np.pi))), {}),
    ),
    "two runs, row by row": (
        ALTERNATING, {}, r"the column that tells (?:them|runs) apart in '(\w+)'",
        lambda key: (ALTERNATING.assign(run=np.arange(1200) % 2), {key: "run"}),
    ),
    "another rate": (
        SLOW, {}, r"add a (\w+) step", lambda name: (SLOW, {"steps": {name: STEPS[name]}}),
    ),
    "gap, resampled": (
        GAP, {"steps": {"resample": RESAMPLE}}, r"put (\w+) before it",
        lambda name: (GAP, {"steps": {name: STEPS[name], "resample": RESAMPLE}}),
    ),
    "copied run": (
        COPIED, SPLIT, r"motions of (\w repeat one of \w), .* keep such runs in one split",
        lambda text: (COPIED, runs(text)),
    ),
    "joint twice": (
        LONG, OF_LONG, r"same time: drop the (row)", lambda _: (LONG.iloc[:-1], OF_LONG),
    ),
    "derived and measured v": (
        changed(w=np.gradient(table()["q"], 0.01)), MEASURED, r"leave out (\w+), or v",
        lambda _: (changed(w=np.gradient(table()["q"], 0.01)), MEASURED | {"steps": {}}),
    ),
    "spike of q": (spike("q"), {}, r"Add the step (.*?), or", lambda x: (spike("q"), append(x))),
    "spike of u": (spike("u"), {}, r"Add the step (.*?), or", lambda x: (spike("u"), append(x))),
}  # fmt: skip


@pytest.mark.usefixtures("language")
@pytest.mark.parametrize("name", ADVICE)
def test_the_advice_repairs_the_log_or_its_description(name):
    files, description, pattern, follow = ADVICE[name]
    try:
        message = "\n".join(read(files, **description).warnings)
    except LogError as error:
        message = str(error)
    advice = re.search(pattern, message)
    assert advice, message
    files, description = follow(advice[1])
    source = read(files, **description)
    assert not re.search(pattern, "\n".join(source.warnings))
    assert max(item.input.u.abs().max() for item in source.load().train) < 2
    assert name == "wrapped angle" or max(x.q.abs().max() for x in source.load().train) < 2
