"""Control laws on known mechanics: their formulas, the contract of controllers, and export."""

import pytest
import torch
from torch import nn

from pinn_dyn.control.export import export_law, load_law
from pinn_dyn.control.laws import ComputedTorque, ProportionalDerivative, Regulation, Tracking
from pinn_dyn.data.simulation import has_cpp_compiler
from pinn_dyn.testing import ControllerContract, assert_near
from pinn_dyn.testing.controller import states
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


class TestLawsOnKnownMechanics(ControllerContract):
    @pytest.fixture(params=LAWS, ids=lambda law: law.__name__)
    def controller(self, request):
        return law_on_known(request.param)


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
    assert_near(controller(0.0, q, v, motion), expected[law], 1e-9)


def test_computed_torque_brings_the_acceleration_that_it_wants():
    controller = law_on_known(ComputedTorque)
    q, v, motion = states(4)
    u = controller(0.0, q, v, motion)
    with torch.no_grad():
        a = controller.model.forward_dynamics(q, v, u)
    assert_near(a, motion.a + KP * (motion.q - q) + KD * (motion.v - v), 1e-8)


class Formula(nn.Module):
    """The formula of a law as a module, which torch.export wants."""

    def __init__(self, controller):
        super().__init__()
        self.model = controller.model
        self.law = controller.law

    def forward(self, *state):
        return self.law(*state)


# That of Regulation is a part of that of Tracking.
@pytest.mark.parametrize("law", [Tracking, ComputedTorque], ids=lambda law: law.__name__)
def test_the_law_is_one_graph(law):
    """As torch.export sees it: no branch on data, and nothing that is computed in Python."""
    controller = law_on_known(law)
    q, v, motion = states(4)
    with torch.no_grad():
        program = torch.export.export(Formula(controller), (q[0], v[0], *(x[0] for x in motion)))
        for k in range(len(q)):
            at = (q[k], v[k], *(x[k] for x in motion))
            assert_near(program.module()(*at), controller.law(*at), 1e-12)


@pytest.mark.slow
@pytest.mark.skipif(not has_cpp_compiler(), reason="there is no C++ compiler")
def test_an_exported_law_on_known_mechanics_is_the_eager_one(tmp_path):
    controller = law_on_known(Tracking)
    loaded = load_law(export_law(controller, tmp_path / "law.pt2"))
    q, v, motion = states(4)
    assert loaded.info["num_coordinates"] == 4
    for k in range(len(q)):
        at = [x.contiguous() for x in (q[k], v[k], *(x[k] for x in motion))]
        with torch.no_grad():
            assert_near(loaded(*at), controller.law(*at), 1e-9)
