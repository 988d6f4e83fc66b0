"""Models of robots that nothing drives: M = 0."""

import itertools

import pytest
import torch

from pinn_dyn.ensembles import Ensemble
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import CoulombFriction, FixedInput, KnownMechanics
from pinn_dyn.models.linear_rival import LinearRival
from pinn_dyn.systems import RigidChain
from pinn_dyn.testing import LinearSystem, MechanicalSystemContract
from tests.models.builders import STEP, make_model, make_statistics, make_structured, random_batch
from tests.support.contracts import one_case
from tests.support.rigid_chains import TREE

T = STEP * torch.arange(60, dtype=torch.float64)


def known():
    chain = RigidChain(TREE, locked_joints=["wrist"])
    model = KnownMechanics(make_statistics(4, 0), chain, friction=CoulombFriction).double()
    model.structure = RigidChain(TREE, locked_joints=["wrist"])
    return model


def rival(n, degree):
    """ARX or EDMDc of an undamped oscillator, whose motion it continues."""
    q, v, _, u = random_batch(n, 0, batch=5)
    eye = torch.eye(n)
    system = LinearSystem(eye, 4 * eye, 0 * eye, torch.zeros(n, 0))
    signal = Signal(T, u.unsqueeze(-2).expand(-1, len(T), -1))
    states = system.predict(torch.cat([q, v], -1), T, signal).detach()
    paths = zip(*states.split(n, -1), strict=True)
    train = [Trajectory(q, v, Signal(T, q.new_zeros(len(T), 0))) for q, v in paths]
    return LinearRival(train, step=STEP, lags=2, degree=degree, ridge=1e-9)


MODELS = {
    **{kind: lambda n, kind=kind: make_model(kind, n, 0) for kind in ("lnn", "hnn")},
    **{
        kind: lambda n, kind=kind: make_model(kind, n, 0) for kind in ("next_state", "acceleration")
    },
    "fixed input": lambda n: make_structured("lnn", n, 0, input=FixedInput),
    "ensemble": lambda n: Ensemble([make_model("lnn", n, 0) for _ in range(3)]),
    "ARX": lambda n: rival(n, 1),
    "EDMDc": lambda n: rival(n, 2),
}


@one_case
class TestLagrangianNetwork(MechanicalSystemContract):
    @pytest.fixture
    def system(self):
        return make_structured("lnn", 2, 0)


@one_case
class TestKnownMechanics(MechanicalSystemContract):
    @pytest.fixture
    def system(self):
        return known()


@pytest.mark.parametrize(("name", "n"), zip(MODELS, itertools.cycle([1, 2, 3]), strict=False))
def test_predictions_without_inputs_are_finite_and_move(name, n):
    model = MODELS[name](n)
    q, v, _, u = random_batch(n, 0, batch=4)
    signal = Signal(T[:4], u.unsqueeze(-2).expand(4, 4, 0))
    with torch.no_grad():
        path = model.predict(torch.cat([q, v], -1), T[:4], signal)
    assert path.shape == (4, 4, 2 * n)
    assert path.isfinite().all()
    assert float((path[:, 1:] - path[:, :-1]).abs().amax()) > 1e-3


def test_no_law_controls_a_robot_without_inputs():
    with pytest.raises(ValueError, match="no inputs"):
        make_model("lnn", 2, 0).require_invertible_input()
