"""Sums of mechanical systems, and known mechanics with a network on top."""

from functools import partial

import pytest
import torch

from pinn_dyn.mechanics import Sum
from pinn_dyn.models import (
    CoulombFriction,
    KnownAndNetwork,
    KnownMechanics,
    LagrangianNetwork,
    LearnedVelocity,
    NetworkCholesky,
    NetworkInput,
    NetworkPotential,
    NetworkResidual,
    NoInput,
    Positive,
    Servo,
)
from pinn_dyn.systems import RigidChain
from pinn_dyn.testing import MechanicalSystemContract, assert_near
from tests.models.builders import make_structured, perturb, random_batch
from tests.support.contracts import one_case
from tests.support.known import statistics
from tests.support.rigid_chains import TREE

SMALL = Positive(floor=0.0, initial=0.1)


def network(input=NoInput, **heads):
    return partial(
        LagrangianNetwork,
        mass=partial(NetworkCholesky, hidden=[6], positivity=SMALL),
        potential=partial(NetworkPotential, hidden=[6], quadratic=False, initial=0.0),
        damping=partial(NetworkCholesky, hidden=[6], positivity=SMALL),
        input=input,
        **heads,
    )


def known(**settings):
    chain = RigidChain(TREE, locked_joints=["wrist"])
    return partial(KnownMechanics, structure=chain, friction=CoulombFriction, **settings)


def both(**settings):
    part = known(gain_spread=0.5, drive_gain=2.0)
    return KnownAndNetwork(statistics(4), part, network(), **settings)


def with_network(**heads):
    return KnownAndNetwork(statistics(4), known(), network(**heads))


def test_a_sum_has_the_stiffness_of_both_parts():
    """Servos stiffen a joint, and the parts of a sum share their targets."""
    parts = [make_structured("lnn", input=Servo) for _ in range(2)]
    matrices = [part.stiffness_matrix(torch.zeros(part.num_coordinates)) for part in parts]
    total = Sum(dict(a=parts[0], b=parts[1])).stiffness_matrix(torch.zeros(len(matrices[0])))
    assert_near(total, matrices[0] + matrices[1], 1e-9)


def exact(model):
    """The model is built in single precision, in which rotations are no longer exact."""
    model.known.structure = RigidChain(TREE, locked_joints=["wrist"])
    return model


@one_case
class TestSum(MechanicalSystemContract):
    """Of two networks with all terms."""

    @pytest.fixture
    def system(self):
        parts = {
            "one": make_structured("lnn"),
            "other": perturb(make_structured("hnn", state="qv", friction=CoulombFriction), seed=5),
        }
        return Sum(parts)


@one_case
class TestKnownAndNetwork(MechanicalSystemContract):
    @pytest.fixture
    def system(self):
        return exact(perturb(both().double(), spread=0.2))


def test_the_terms_add():
    one, other = make_structured("lnn"), perturb(make_structured("lnn"), seed=5)
    total = Sum({"one": one, "other": other})
    q, v, _, u = random_batch(3, 3)
    for found, a, b in zip(total.terms(q), one.terms(q), other.terms(q), strict=True):
        assert_near(found, a + b, 1e-12)
    coriolis = one.coriolis_matrix(q, v) + other.coriolis_matrix(q, v)
    assert_near(total.coriolis_matrix(q, v), coriolis, 1e-9)
    supplied = one.power(q, v, u) + other.power(q, v, u)
    assert_near(total.power(q, v, u), supplied, 1e-9)


def test_scales_of_the_network_are_those_of_torques():
    """Twice the drive gain, twice the torques that its terms start from."""
    q = random_batch(4, 4, dtype=torch.float32)[0]
    models = []
    for gain in (2.0, 4.0):
        torch.manual_seed(0)
        models.append(KnownAndNetwork(statistics(4), known(drive_gain=gain), network()))
    one, two = models
    assert torch.allclose(two.force, 2 * one.force)
    mass = [model.parts["network"].mass_matrix(q) for model in models]
    assert torch.allclose(mass[1], 2 * mass[0], rtol=1e-4)


def test_what_the_network_contributes_is_penalized():
    residual = partial(NetworkResidual, hidden=[4], weight=0.7)
    model = perturb(both(weight=0.3, residual=residual).double())
    q, v, a, u = random_batch(4, 4)
    part = model.parts["network"]
    tau = part.mass_matrix(q) @ a[..., None] + part.coriolis_matrix(q, v) @ v[..., None]
    tau = tau[..., 0] + part.potential_force(q) + part.dissipative_force(q, v)
    r = model.residual_force(q, v, u)
    expected = 0.3 * ((tau / model.force) ** 2).mean() + 0.7 * ((r / model.force) ** 2).mean()
    assert float(r.abs().max()) > 0
    assert_near(model.penalty(q, v, a, u), expected, 1e-9)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        *(
            (lambda head=head: with_network(**head), f"network.{next(iter(head))} is a head .*")
            for head in (
                {"input": partial(NetworkInput, hidden=[4])},
                {"residual": partial(NetworkResidual, hidden=[4])},
                {"initial_velocity": partial(LearnedVelocity, hidden=[4])},
            )
        ),
        (
            lambda: Sum({"a": make_structured("lnn", 2, 2), "b": make_structured("lnn", 3, 3)}),
            r"the parts of a sum have \(N, M\) .*'b': \(3, 3\)",
        ),
    ],
)
def test_a_sum_that_cannot_be_is_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
