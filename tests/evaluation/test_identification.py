"""Intervals of constants, and directions that stay open."""

import pytest
import torch

from pinn_dyn.evaluation.identification import constants_table, undetermined
from pinn_dyn.models import AsymmetricCoulomb
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
