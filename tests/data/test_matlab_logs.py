"""A motion in the forms of MATLAB and Simulink gives the trajectories of the same CSV."""

import itertools
import re

import matio
import numpy as np
import pandas as pd
import pytest
from matio.utils import MatlabOpaque

from pinn_dyn.data.logs import LogError
from tests.data.logs_files import assert_read, motion, named, source

TABLE = motion(6.0)
T, Q, V, U = (TABLE.filter(regex=f"^{name}").to_numpy() for name in "tqvu")
SIGNALS = {"t": T, "q": Q, "v": V, "u": U}


def structs(items, shape=None):
    array = np.empty(shape or (1, len(items)), dtype=[(name, object) for name in items[0]])
    for k, item in enumerate(items):
        array[np.unravel_index(k, array.shape, order="F")] = tuple(item.values())
    return array


def cells(items):
    array = np.empty((1, len(items)), dtype=object)
    array[0, :] = items
    return array


def opaque(classname, **properties):
    return MatlabOpaque(properties=properties, classname=classname)


def timeseries(data, *, uniform=False, start=T[0, 0]):
    """Return a time series as MATLAB saves it; a uniform clock has a start, a step and a length."""
    none = np.empty((0, 0))
    step = np.array([[T[1, 0] - T[0, 0]]])
    info = dict(Start_=np.array([[start]]), Increment_=step, Length=np.array([[float(len(T))]]))
    return opaque(
        "timeseries",
        Name="",
        TimeInfo=opaque("tsdata.timemetadata", Units="seconds", Time_=none, **info),
        Data_=data.T[:, None, :],  # each sample is a vector
        Time_=none if uniform else T,
    )


def data_set():
    elements = [
        opaque("Simulink.SimulationData.Signal", Name=name, Values=timeseries(x, uniform=True))
        for name, x in (("q", Q), ("v", V), ("u", U))
    ]
    storage = opaque("Simulink.SimulationData.Storage.RamDatasetStorage", Elements=cells(elements))
    content = structs([dict(Name="logsout", Storage=storage)])
    return opaque("Simulink.SimulationData.Dataset", any=content)


def scope():
    signals = structs([dict(values=x, label="") for x in (Q, V.T[:, None, :], U)])
    return dict(time=T, signals=signals, blockName="arm/Scope")


FORMS = {
    "rows": ({name: x.T for name, x in SIGNALS.items()}, named("{}_{}")),
    "nested": (
        {"log": {"arm": SIGNALS}, "f": {"M": np.eye(3), "e": []}},
        named("log.arm.{}_{}", "log.arm.t"),
    ),
    "matrix": (
        {"data": np.hstack([T, Q, V, U])},
        dict(
            time=dict(columns="data_1", unit="s"),
            q=dict(columns=["data_2", "data_3"], unit="rad"),
            v=dict(columns=["data_4", "data_5"], unit="rad/s"),
            u=dict(columns=["data_6", "data_7"], unit="Nm"),
        ),
    ),
    "sample time": ({**SIGNALS, "t": T[1] - T[0]}, named("{}_{}")),
    "one element": (
        {"trial": structs([{name: 2 * x for name, x in SIGNALS.items()}, SIGNALS])},
        named("trial(2).{}_{}", "trial(2).t"),
    ),
    "timetable": (
        {
            "TT": TABLE.drop(columns="t").set_index(
                pd.to_timedelta(T[:, 0], unit="s").rename("Time")
            )
        },
        named("TT.{}{}", "TT.Time"),
    ),
    "table": ({"log": TABLE}, named("log.{}{}", "log.t")),
    "timeseries": (
        {name: timeseries(x) for name, x in zip("qvu", (Q, V, U), strict=True)},
        named("{}.Data_{}", "q.Time"),
    ),
    "data set": (
        {"out": {"logsout": data_set(), "simTime": 0.3}},
        named("out.logsout.{}.Data_{}", "out.logsout.q.Time"),
    ),
    "structure with time": (
        {"ScopeData": scope()},
        dict(
            time=dict(columns="ScopeData.time", unit="s"),
            q=dict(columns=[f"ScopeData.signals.values_{k}" for k in (1, 2)], unit="rad"),
            v=dict(columns=[f"ScopeData.signals(2).values_{k}" for k in (1, 2)], unit="rad/s"),
            u=dict(columns=[f"ScopeData.signals.values_{k}" for k in (5, 6)], unit="Nm"),
        ),
    ),
}


@pytest.mark.parametrize(
    ("form", "version"), zip(FORMS, itertools.cycle(["v7", "v7.3"]), strict=False)
)
def test_forms_of_matlab_give_the_same_motion(tmp_path, form, version):
    content, description = FORMS[form]
    matio.save_to_mat(str(tmp_path / "run.mat"), content, version=version)
    assert_read(source(tmp_path, files="run.mat", **description), TABLE)


def test_a_scalar_rate_is_no_sample_time_and_the_advice_works(tmp_path):
    matio.save_to_mat(str(tmp_path / "run.mat"), {**SIGNALS, "t": 0, "fs": 100.0}, version="v7")
    description = {**named("{}_{}"), "time": dict(columns="fs", unit="s")}
    with pytest.raises(LogError, match="fs is a rate") as error:
        source(tmp_path, files="run.mat", **description).load()
    rate = float(re.search(r"write time=\{'rate': (.*?)\}", str(error.value))[1])
    assert_read(source(tmp_path, files="run.mat", **description | {"time": {"rate": rate}}), TABLE)


@pytest.mark.parametrize(
    ("form", "version"),
    [
        (lambda trials: {"trial": structs(trials)}, "v7.3"),
        (lambda trials: {f"trial_{x}": cells([y[x] for y in trials]) for x in "tqvu"}, "v7"),
    ],
)
def test_elements_are_runs(tmp_path, form, version):
    trials = [
        {name: x[: 200 + k] * (1 + k) ** (name != "t") for name, x in SIGNALS.items()}
        for k in range(4)
    ]
    empty = {name: np.empty((0, 0)) for name in trials[0]}  # of a trial that was aborted
    content = form([*trials, empty])
    matio.save_to_mat(str(tmp_path / "run.mat"), content, version=version)
    prefix = "trial." if "trial" in content else "trial_"
    columns, part = named(f"{prefix}{{}}_{{}}", f"{prefix}t"), dict(runs=1, piece=0.5)
    log = source(tmp_path, files="run.mat", **columns, validation=part, test=part)
    recordings = {x.raw.run: x.raw for x in log.cleaned}
    assert len(recordings) == 4
    np.testing.assert_allclose(recordings["3"].q, trials[2]["q"])


@pytest.mark.parametrize("longer", ["t", "tqv"])
def test_times_or_states_at_both_ends_of_the_steps(tmp_path, longer):
    ends = {name: np.concatenate([SIGNALS[name], SIGNALS[name][:1]]) for name in longer}
    ends["t"][-1] = 2 * T[-1] - T[-2]
    matio.save_to_mat(str(tmp_path / "run.mat"), {**SIGNALS, **ends}, version="v7")
    log = source(tmp_path, files="run.mat", **named("{}_{}"))
    assert log.warnings == ["run: the last row is left out: some variables are a row shorter"]
    for part in log.cleaned:
        rows = np.searchsorted(T[:, 0], part.raw.t - 1e-6)
        np.testing.assert_allclose(part.raw.q, Q[rows])
        np.testing.assert_allclose(part.raw.u, U[rows])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            dict(u=U[::10]),
            r"'u_1' has type float64 and shape \(61, 2\), expected real numbers in 601 rows",
        ),
        (dict(t=np.empty(0), fs=100.0), r"no variable 't'.*write time=\{'rate': 100.0\}.*fs = 100"),
    ],
)
def test_variables_that_do_not_fit_are_named_with_their_sizes(tmp_path, changes, message):
    matio.save_to_mat(str(tmp_path / "run.mat"), {**SIGNALS, **changes}, version="v7")
    with pytest.raises(LogError, match=message):
        source(tmp_path, files="run.mat", **named("{}_{}")).load()
