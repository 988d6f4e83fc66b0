"""Control laws on known mechanics: their formulas and the contract of controllers."""

import pytest
import torch
from torch import nn

from pinn_dyn.control.laws import ComputedTorque, ProportionalDerivative, Regulation, Tracking
from pinn_dyn.testing import ControllerContract, assert_near
from pinn_dyn.testing.controller import input_of, states
from tests.support.contracts import one_case
from tests.support.known import known_model

LAWS = [ProportionalDerivative, Regulation, Tracking, ComputedTorque]
KP, KD = torch.tensor([9.0, 7.0, 5.0, 3.0]).double(), torch.tensor([2.0, 1.5, 1.0, 0.5]).double()


def model_of_currents():
    """Four joints with friction and drive gains, away from the start."""
    model = known_model(drive_gain=4.0, gain_spread=0.5)
    generator = torch.Generator().manual_seed(3)
    for parameter in model.parameters():
        nn.init.normal_(parameter, std=0.2, generator=generator)
    return model.eval()


def law_on_known(law):
    return law(model_of_currents(), KP.tolist(), KD.tolist())


@one_case
class TestLawsOnKnownMechanics(ControllerContract):
    @pytest.fixture
    def controller(self):
        return law_on_known(ComputedTorque)


def force(model, q, v, a):
    """M a + C v + G + D v + F by the regressor, as no law computes it."""
    bodies = model.structure.regressor(q, v, a) @ model.body_parameters().flatten()
    drives = model.armature() * a + model.viscous() * v + model.friction(v) - model.offset()
    return (bodies + drives).detach()


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
def test_inputs_are_the_formulas_in_the_unit_of_the_drives(law):
    controller = law_on_known(law)
    model, gain = controller.model, controller.model.drive_gain().detach()
    q, v, motion = states(4)
    rest = torch.zeros_like(q)
    pd = KP * (motion.q - q) + KD * (motion.v - v)
    expected = {
        ProportionalDerivative: gain * pd,
        Regulation: force(model, q, rest, rest) / gain + gain * pd,
        Tracking: force(model, *motion) / gain + gain * pd,
        ComputedTorque: force(model, q, v, motion.a + pd) / gain,
    }
    assert_near(input_of(controller, q, v, motion), expected[law], 1e-9)
