"""Intervals of constants, and directions that stay open."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch

from pinn_dyn.identification.constants import (
    constants_table,
    contradicted,
    far_masses,
    undetermined,
)
from pinn_dyn.identification.rigid_excitation import rigid_excitation
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import AsymmetricCoulomb
from pinn_dyn.run.training.fit_constants import write_constants
from pinn_dyn.training import Fit
from pinn_dyn.training.constants_fit import Prior
from tests.support.known import known_model


def fit_with(model, variances):
    return fit_of(torch.diag(torch.as_tensor(variances, dtype=torch.float64)))


def fit_of(covariance):
    information = torch.linalg.inv(covariance) - torch.eye(len(covariance)).double()
    prior = Prior(torch.zeros(len(covariance)).double(), torch.eye(len(covariance)).double())
    return Fit(covariance, information, prior, 0.0, 1)


@pytest.fixture
def model():
    return known_model(friction=None, gain_spread=0.5, drive_gain=2.0)


def test_intervals_follow_from_the_covariance(model):
    names = model.parameter_names()
    variances = [0.01 if name == "drive gain of turn" else 0.25 for name in names]
    table = constants_table(model, fit_with(model, variances)).set_index("name")
    gain = table.loc["drive gain of turn"]
    # k = 2 exp(0.5 z) at z = 0 has the slope 1.
    assert gain.value == pytest.approx(2.0)
    assert gain.high - gain.value == pytest.approx(1.96 * 0.1)
    assert gain.known == pytest.approx(0.99)
    # m ~ exp(2 a), a = 3 z: of the ten parameters of a body the mass depends on one.
    mass = table.loc["mass of slider"]
    assert mass.high - mass.value == pytest.approx(1.96 * 0.5 * 6 * mass.value)
    assert mass.unit == "kg"


def test_undetermined_parameters_are_named_one_by_one(model):
    """The eigenvectors mix three parameters, none of which has anything to do with the others."""
    names = model.parameter_names()
    undetermined_names = ["mass of slider", "x extent of slider", "armature of bend"]
    indices = [names.index(name) for name in undetermined_names]
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)))[0]
    block = turn.double() @ torch.diag(torch.tensor([0.7, 0.8, 0.9]).double()) @ turn.double().T
    covariance = 0.01 * torch.eye(len(names)).double()
    covariance[torch.tensor(indices)[:, None], torch.tensor(indices)] = block
    lines = undetermined(model, fit_of(covariance))
    assert {text.split(":")[0] for text in lines} == set(undetermined_names)


def test_widths_that_rollouts_with_sticking_do_not_use_are_not_undetermined():
    model = known_model(friction=AsymmetricCoulomb)
    names = model.parameter_names()
    variances = torch.full((len(names),), 0.01).double()
    variances[[name.startswith("friction width of") for name in names]] = 1.0
    assert not undetermined(model, fit_with(model, variances))
    variances[names.index("friction width of slide")] = 0.9  # an identification uses the widths
    variances[names.index("mass of slider")] = 1.0
    lines = undetermined(model, fit_with(model, variances))
    named = {text.split(":")[0] for text in lines}
    assert named == {"friction width of slide", "mass of slider"}


def test_what_no_data_determine_keeps_the_width_of_the_prior(model):
    """Though its slope has become small on the way from the start."""
    names = model.parameter_names()
    fit = fit_with(model, [1.0] * len(names))
    before = constants_table(model, fit).set_index("name")
    with torch.no_grad():
        model.bodies.z[1, 0] -= 2  # the slider's mass, to a fiftieth
    after = constants_table(model, fit).set_index("name")
    width = after.high - after.value
    assert width["mass of slider"] == pytest.approx((before.high - before.value)["mass of slider"])
    assert after.known["mass of slider"] == pytest.approx(0, abs=1e-9)
    assert after.value["mass of slider"] < 0.1 * before.value["mass of slider"]


def test_no_interval_goes_below_what_a_constant_can_be():
    model = known_model(friction=AsymmetricCoulomb)
    table = constants_table(model, fit_with(model, [1.0] * len(model.parameter_names())))
    table = table.set_index("name")
    zero = ["mass of slider", "Izz of slider", "armature of slide", "friction width of slide"]
    for name in zero:
        assert table.low[name] == 0
    # Data give an upper limit of a width: sticking and a filter look like a width.
    precise = constants_table(model, fit_with(model, [1e-6] * len(model.parameter_names())))
    assert precise.set_index("name").low["friction width of slide"] == 0
    assert table.low["m cx of slider"] < 0
    assert table.low["force offset of slide"] < 0


def test_constants_have_the_units_of_their_joint_and_of_the_input(model):
    fit = fit_with(model, [0.5] * len(model.parameter_names()))
    units = constants_table(model, fit, ["A", "A", "V", "A"]).set_index("name").unit
    assert units["armature of turn"] == "kg m^2"
    assert units["armature of slide"] == "kg"
    assert units["viscous friction of turn"] == "Nms/rad"
    assert units["viscous friction of slide"] == "Ns/m"
    assert units["torque offset of turn"] == "Nm"
    assert units["force offset of slide"] == "N"
    assert units[[f"drive gain of {name}" for name in model.structure.joint_names]].tolist() == [
        "Nm/A",
        "N/A",
        "Nm/V",
        "Nm/A",
    ]
    assert constants_table(model, fit).set_index("name").unit["drive gain of turn"] == "Nm/u"


def test_motions_leave_open_what_the_check_of_a_log_names(model, tmp_path):
    """The slider rests in one of two logs, and all joints move in the other."""
    t = 0.01 * torch.arange(600).double()
    rates = torch.tensor([[1.1, 1.7, 2.3, 3.1], [4.3, 5.9, 7.1, 3.7]]).double()
    phases = t[:, None, None] * rates
    q, v = phases.sin().sum(1), (rates * phases.cos()).sum(1)
    runs = [Trajectory(q, v, Signal(t, q))]
    resting = [Trajectory(q * RESTING, v * RESTING, Signal(t, q))]
    fit, counts = fit_with(model, [1.0] * len(model.parameter_names())), []
    for motion in (runs, resting):
        excitation = rigid_excitation(model.structure, motion, cutoff=6.0)
        source = SimpleNamespace(input_labels=list("uuuu"))
        write_constants(model, fit, source, tmp_path, motion, cutoff=6.0)
        text = (tmp_path / "undetermined.md").read_text()
        lines = [line[2:] for line in text.splitlines() if line.startswith("- ")]
        assert ("; ".join(lines) or "none") == excitation.undetermined
        assert text.startswith(f"{len(lines)} of {excitation.count} base parameters")
        move = f"Move {', '.join(excitation.open_joints)} at more"
        assert (move in text) == bool(lines)
        counts.append(len(lines))
        assert "per drive gain only" in text
    assert counts[0] < counts[1]


RESTING = torch.tensor([1, 0, 1, 1])


def test_bodies_and_gains_that_data_move_far_from_their_prior_are_named():
    model = known_model(friction=None, gain_spread=0.5, spread={"default": 0.3, "elbow": 3.0})
    fit = fit_with(model, [0.5] * len(model.parameter_names()))
    with torch.no_grad():
        model.bodies.z[0, :2] = torch.tensor([-3.5, 2.9])
        model.gain.z[1] = 4.2
        model.viscous.z[2] = -5.0  # the prior of friction is a guess
    body, gain = contradicted(model, fit)
    assert body.startswith("the data move shoulder far from its prior, mass by 3.5 standard")
    assert body.endswith("'model.spread={default: 0.3, shoulder: 3}'")
    assert gain.startswith("the data move slide far from its prior, drive gain by 4.2 standard")
    later = fit.prior._replace(mean=fit.prior.mean + 1)
    assert not contradicted(model, replace(fit, prior=later))  # the prior is an earlier fit


def test_masses_whose_interval_is_far_from_that_of_the_urdf_are_named():
    names = ["mass of arm", "mass of hand", "mass of tool", "mass of base", "damping of arm"]
    values = [1360.0, 4.0, 0.2, 3.5, 90.0]
    table = pd.DataFrame({"name": names, "value": values, "start": 1.0})
    width = np.array([20.0, 1.5, 0.05, 0.1, 1.0])
    table = table.assign(low=table.value - width, high=table.value + width)
    (text,) = far_masses(table)
    assert [name for name in names if name in text] == [
        "mass of arm",
        "mass of tool",
        "mass of base",
    ]
    assert "the mass of arm is 1.36e+03 kg (1.34e+03 to 1.38e+03), in the URDF 1 kg" in text
    assert far_masses(table[table.name == "mass of hand"]) == []
