"""Intervals of constants, and directions that stay open."""

import pytest
import torch

from pinn_dyn.evaluation.identification import constants_table, undetermined
from pinn_dyn.training import Fit
from pinn_dyn.training.constants_fit import Prior
from tests.support.known import known_model


def fit_with(model, variances):
    covariance = torch.diag(torch.as_tensor(variances, dtype=torch.float64))
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


def test_open_directions_are_named(model):
    names = model.parameter_names()
    open_ones = {"mass of slider": 0.95, "armature of bend": 0.7}
    words = undetermined(model, fit_with(model, [open_ones.get(name, 0.01) for name in names]))
    assert [text.split(":")[0] for text in words] == list(open_ones)
    assert "95%" in words[0]


def test_what_no_data_determine_keeps_the_width_of_the_prior(model):
    """Though its slope has become small on the way from the start."""
    names = model.parameter_names()
    fit = fit_with(model, [1.0] * len(names))
    before = constants_table(model, fit).set_index("name")
    with torch.no_grad():
        model.bodies.z[1, 0] -= 2  # the slider's mass, to a fiftieth
    after = constants_table(model, fit).set_index("name")
    width = after.high - after.low
    assert width["mass of slider"] == pytest.approx((before.high - before.low)["mass of slider"])
    assert after.known["mass of slider"] == pytest.approx(0, abs=1e-9)
    assert after.value["mass of slider"] < 0.1 * before.value["mass of slider"]
