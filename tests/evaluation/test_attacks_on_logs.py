"""Faults planted into clean logs of random arms without a URDF: each is named, or none is."""

import re

import pytest

from pinn_dyn.data.logs import LogSource
from pinn_dyn.log_check.chain import EXCHANGED, FRICTION, SIGN
from pinn_dyn.log_check.check import check
from pinn_dyn.log_check.runs import RESIDUAL
from tests.evaluation.test_clean_logs import EXCITATION, clean_log

DELAY = "delay [ms]"


def reversed_torque(frames, k):
    for frame in frames.values():
        frame[f"u{k}"] *= -1
    return f"input 'u{k}' seems"


def exchanged_torques(frames, k):
    pair = [f"u{k}", "u0" if k else "u1"]
    for frame in frames.values():
        frame[pair] = frame[pair[::-1]].to_numpy()
    return " and ".join(repr(x) for x in sorted(pair))


def late_torque(frames, k):
    for frame in frames.values():
        frame[f"u{k}"] = frame[f"u{k}"].shift(-3).ffill()
    return f"input 'u{k}' acts"


def turned_back(frame):
    table = frame.iloc[::-1].reset_index(drop=True).assign(t=frame["t"])
    speeds = [x for x in table if x.startswith("v")]
    table[speeds] *= -1
    return table


def run_backwards(frames, k):
    frames["run2"] = turned_back(frames["run2"])
    return "run run2 does not fit.*does the time run backwards"


def log_backwards(frames, k):
    frames |= {name: turned_back(frame) for name, frame in frames.items()}
    return "does the time of the log run backwards"


def stuck_torque(frames, k):
    table, half = frames["run2"], len(frames["run2"]) // 2
    table.loc[half:, f"u{k}"] = table[f"u{k}"].iloc[half]
    return f"run run2 does not fit.*input {k + 1} is constant there"


def other_zero(frames, k):
    """The last joint of a run: another payload may look like it, and its motion may hide it."""
    table = frames["run2"]
    table[max(x for x in table if x.startswith("q"))] += 0.3
    return "run run2 does not fit.*is it another payload or unit, or are columns"


ATTACKS = {
    # Fault, name of its measurement, and if it may stay silent.
    reversed_torque: (SIGN, False),
    exchanged_torques: (EXCHANGED, False),
    late_torque: (DELAY, True),
    run_backwards: (RESIDUAL, False),
    log_backwards: (FRICTION, False),
    stuck_torque: (RESIDUAL, False),
    other_zero: (RESIDUAL, True),
}
CASES = [
    pytest.param(attack, seed, marks=pytest.mark.slow if seed not in (1, 6, 11) else ())
    for seed in (1, 6, 11, 30, 33, 36, 39)
    for attack in ATTACKS
]


@pytest.mark.parametrize(("attack", "seed"), CASES, ids=lambda x: getattr(x, "__name__", x))
def test_a_fault_of_a_random_arm_gets_its_word_and_no_other(attack, seed):
    clean, _ = clean_log(seed)
    frames = {name: frame.copy() for name, frame in clean.files.items()}
    words = attack(frames, seed % len(clean.q.columns))
    columns = {name: getattr(clean, name) for name in "qvu"}
    result = check(LogSource(files=frames, time="t", **columns))
    bad = [x for x in result.measurements if x.verdict != "ok"]
    bad = [x for x in bad if not x.name.startswith(EXCITATION)]
    name, may_be_silent = ATTACKS[attack]
    assert {x.name for x in bad} == {name} or (may_be_silent and not bad)
    assert len(bad) <= 1
    for x in bad:
        assert re.search(words, x.text), x.text
