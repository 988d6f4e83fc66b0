"""The comparison of control laws on a robot, from Python."""

import functools

import numpy as np
import pandas as pd
import pytest
import torch

import pinn_dyn
from pinn_dyn.control import Actuator, Regulation, SetPoint, Sines, Tracking
from pinn_dyn.evaluation import close_loops
from pinn_dyn.systems import SoftArm

TARGET = SetPoint([0.3, 0.2, 0.1])
REST = torch.zeros(2, 3, dtype=torch.float64)


def test_a_wrong_model_has_a_larger_error_than_the_truth(tmp_path):
    law = functools.partial(Tracking, position_gain=5.0, velocity_gain=0.4)
    reference = Sines([0.2, 0.1, 0.1], 0.05, 0.5)
    heavy = SoftArm(mass=0.5).double()
    result = pinn_dyn.close_loop(heavy, law, reference, SoftArm(), duration=0.2, rate=200.0)
    errors = result.table.set_index("controller")["rms_error"]
    assert list(errors.index) == ["learned", "truth"]
    assert errors["learned"] > 10 * errors["truth"]
    result.save(tmp_path)
    assert pd.read_csv(tmp_path / "summary.csv")["rms_error"].tolist() == pytest.approx([*errors])
    assert len(pd.read_csv(tmp_path / "coordinates.csv")) == 6
    with np.load(tmp_path / "record_truth.npz") as record:
        np.testing.assert_array_equal(record["u"], result.records["truth"].u)


def test_limits_and_initial_states_reach_the_loop():
    laws = {"law": Regulation(SoftArm(), 20.0, 4.0)}
    settings = {"duration": 0.1, "rate": 200.0, "q0": REST, "v0": REST, "settled_after": 0.05}
    result = close_loops(laws, TARGET, SoftArm(), actuator=Actuator(-0.5, 0.5), **settings)
    record = result.records["law"]
    assert torch.equal(record.q[:, 0], REST)
    assert record.u.abs().max() == 0.5
    assert {"saturated_samples", "step_error_after_0.05_s_mean_percent"} <= set(result.table)
