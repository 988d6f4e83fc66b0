"""Any system with constants as a model: its own terms, positive constants, bad input by name."""

import pytest
import torch

from pinn_dyn.models import KnownMechanics, KnownSystem
from pinn_dyn.systems import SoftArm
from pinn_dyn.testing import MechanicalSystemContract
from tests.support.cart_pole import CartPole
from tests.support.contracts import one_case, slow_except
from tests.support.known import anywhere, known_arm, known_cart_pole, statistics


@one_case
class TestKnownSoftArmContract(MechanicalSystemContract):
    """Away from the start; a segment of 2 m bends and lengthens by up to one."""

    @pytest.fixture(params=slow_except([1, 2], [1]), ids=["one", "two"])
    def system(self, request):
        return anywhere(known_arm(request.param), std=0.3)


@one_case
class TestKnownCartPoleContract(MechanicalSystemContract):
    """Of a system that gives its four terms alone, with fewer inputs than coordinates."""

    @pytest.fixture
    def system(self):
        return anywhere(known_cart_pole(), std=0.1)


def values(model):
    return {
        name: value
        for item in model.physical_constants()
        for name, value in zip(item.names, item.values.tolist(), strict=True)
    }


@pytest.mark.parametrize("segments", [1, 2])
def test_the_model_is_the_system_of_the_learned_constants(segments):
    model = anywhere(known_arm(segments), std=0.5)
    entries = list(values(model).values())
    n, size = segments, 3 * segments
    arm = SoftArm(
        segments,
        length=2.0,
        mass=entries[:n],
        stiffness=entries[n : n + size],
        damping=entries[n + size :],
    )
    at = 0.3 * torch.randn(3, 8, size, generator=torch.Generator().manual_seed(1)).double()
    torch.testing.assert_close(model.inverse_dynamics(*at), arm.inverse_dynamics(*at))
    torch.testing.assert_close(model.forward_dynamics(*at), arm.forward_dynamics(*at))
    for own, expected in zip(model.terms(at[0]), arm.terms(at[0]), strict=True):
        torch.testing.assert_close(own, expected)


def test_the_missing_force_is_the_sum_of_what_each_constant_contributes():
    """Linear in the constants: masses of point masses at Gauss nodes, springs and dampers by hand.

    Inertia and weight of one segment by finite differences of the backbone along the motion
    q + v t + a t^2 / 2, which know nothing of Jacobians and biases.
    """
    model = anywhere(known_arm(), std=0.5)
    mass, *rest = values(model).values()
    stiffness, damping = torch.tensor(rest).double().split(3)
    q, v, a, u = 0.3 * torch.randn(4, 5, 3, generator=torch.Generator().manual_seed(2)).double()
    kinematics = SoftArm(1, length=2.0)

    def positions(x):
        return kinematics.backbone(x, kinematics._s).flatten(-3, -2)

    step = 1e-4
    path = [positions(q + v * t + a * t**2 / 2) for t in (-step, 0.0, step)]
    acceleration = (path[0] - 2 * path[1] + path[2]) / step**2
    pull = acceleration - torch.tensor([0, 0, 9.81]).double()
    tiny = 1e-6 * torch.eye(3).double()
    slopes = [(positions(q + d) - positions(q - d)) / 2e-6 for d in tiny]
    weights = kinematics._weights[:, None]
    inertial = torch.stack([(slope * pull * weights).sum((-2, -1)) for slope in slopes], -1)
    driven = (kinematics.input_matrix(q) @ u.unsqueeze(-1)).squeeze(-1)
    expected = mass * inertial + stiffness * q + damping * v - driven
    torch.testing.assert_close(model.missing_force(q, v, a, u), expected, rtol=1e-5, atol=1e-5)


def test_what_acts_on_no_coordinate_is_weighed_by_its_inertia():
    model = known_cart_pole()
    q, v, a = torch.randn(3, 50, 2).double()
    u = torch.randn(50, 1).double()
    with torch.no_grad():
        scale = model.force_scale(q, v, a, u)
        inertia = (model.mass_matrix(q) @ a.unsqueeze(-1))[:, 1, 0]
    assert float(scale[0]) == pytest.approx(float(u.std()))
    assert float(scale[1]) == pytest.approx(float(inertia.std()))


class Unnamed(SoftArm):
    def __init__(self):
        super().__init__()
        self.constants = {}


class Unmeasured(SoftArm):
    def __init__(self):
        super().__init__()
        self.constants = {"stiffness": ["N/m"]}


@pytest.mark.parametrize(
    ("structure", "message"),
    [
        (Unnamed(), r"structure Unnamed has the constants \{\}, expected a unit"),
        (Unmeasured(), "Unmeasured has the constants .*stiffness.*expected a unit for each entry"),
        (SoftArm(stiffness=0.0), r"stiffness 1: start is .* expected positive"),
        (CartPole(), "but CartPole has 2 coordinates and 1 inputs"),
    ],
)
def test_a_structure_that_cannot_be_learned_is_refused_by_name(structure, message):
    with pytest.raises(ValueError, match=message):
        KnownSystem(statistics(3), structure)


def test_known_mechanics_takes_rigid_bodies():
    with pytest.raises(ValueError, match=r"structure is a SoftArm, .* model=known_system"):
        KnownMechanics(statistics(3), SoftArm())
