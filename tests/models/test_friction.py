"""Dry friction is passive for every parameter, and reports the constants that act."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from pinn_dyn.mechanics import Signal
from pinn_dyn.models import (
    AsymmetricCoulomb,
    CoulombFriction,
    NoFriction,
    Stribeck,
)
from pinn_dyn.testing import FrictionContract, assert_near
from tests.models.builders import make_scales, make_structured, perturb
from tests.support.contracts import one_case
from tests.support.known import anywhere, known_model, unit_scales

LAWS = [CoulombFriction, AsymmetricCoulomb, Stribeck]
FORCE = torch.tensor([0.5, 2.0, 3.0], dtype=torch.float64)


@pytest.mark.parametrize(
    ("law", "prior"),
    [(NoFriction, False), (CoulombFriction, True), (AsymmetricCoulomb, False), (Stribeck, True)],
)
@one_case
class TestFriction(FrictionContract):
    @pytest.fixture
    def head(self, law, prior):
        scales = unit_scales(3, prior=True) if prior else make_scales(3, 2, FORCE)
        return perturb(law(scales).double(), spread=0.4)


@pytest.mark.parametrize("law", LAWS)
@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 1000),
    std=st.floats(0.1, 3),
    v=st.floats(-1e6, 1e6),
    prior=st.booleans(),
)
def test_friction_takes_energy_whatever_its_parameters(law, seed, std, v, prior):
    friction = anywhere(law(unit_scales(2, prior=prior)), std=std, seed=seed)
    v = torch.full((2,), v, dtype=torch.float64)
    with torch.no_grad():
        assert (v * friction(v) >= 0).all()


def sliding_mass():
    """A free mass with friction alone: the model, m, c and w."""
    model = make_structured("lnn", n=1, m=1, friction=CoulombFriction)
    with torch.no_grad():
        for head in (model.potential, model.mass, model.damping):
            for parameter in head.parameters():
                parameter.zero_()
    model.damping.network.linears[-1].bias.data.fill_(-80.0)
    mass = float(model.mass_matrix(torch.zeros(1, 1, dtype=torch.float64)).detach())
    level, width = (float(x().detach()) for x in (model.friction.level, model.friction.width))
    return model, mass, level, width


def test_friction_alone_stops_a_free_mass_and_takes_its_energy():
    """m v' = -c tanh(v/w): sinh(v/w) = sinh(v0/w) exp(-c t/(m w)), a closed form."""
    model, mass, level, width = sliding_mass()
    t = torch.linspace(0, mass * width / level, 101, dtype=torch.float64)
    v0 = 2 * width
    x0 = torch.tensor([[0.0, v0]], dtype=torch.float64)
    with torch.no_grad():
        x = model.predict(x0, t, Signal(t, torch.zeros(1, 101, 1, dtype=torch.float64)))
    expected = width * torch.asinh(
        torch.sinh(x0[:, 1:] / width) * torch.exp(-level * t / (mass * width))
    )
    assert_near(x[..., 1], expected, 1e-8)
    # What the mass lost is the work of the friction along the way.
    work, _ = quad(lambda v: mass * v, float(x[0, -1, 1]), v0)
    energy = model.total_energy(x[..., :1], x[..., 1:]).detach()
    assert_near(energy[:, 0] - energy[:, -1], torch.tensor([work], dtype=torch.float64), 1e-8)


# The constants in the table of a fit.


@pytest.mark.parametrize("law", LAWS)
def test_every_law_is_in_the_table_of_known_mechanics(law):
    """Each parameter has a name, and every constant of the law a row with a value and a unit."""
    model = known_model(friction=law)
    names = model.parameter_names()
    assert len(names) == len(set(names)) == sum(p.numel() for p in model.parameters())
    rows = [name for item in model.physical_constants() for name in item.names]
    assert len(rows) == len(names)
    assert [name for name in rows if name.startswith("Coulomb friction")]
    assert "friction width of slide" in rows


def test_parameters_of_an_own_head_are_in_the_table_too():
    """So a fit with a head that is no law of the package ends in a table, not in an error."""

    class Cubic(NoFriction):
        def __init__(self, scales):
            super().__init__(scales)
            self.factor = torch.nn.Parameter(torch.zeros(scales.size))
            self.rate = scales.positive("drag", 0.1, scales.value, 1.0, "damping")

    model = known_model(friction=None)
    model.friction = Cubic(unit_scales(4))
    names = model.parameter_names()
    assert names[-8:-4] == [f"friction.factor {k}" for k in range(1, 5)]
    assert len(names) == sum(p.numel() for p in model.parameters())
    rows = [name for item in model.physical_constants() for name in item.names]
    assert len(rows) == len(names)
    assert rows[-8:] == [f"factor {k}" for k in range(1, 5)] + names[-4:]


def test_reported_friction_is_what_acts():
    """Level of each direction and width, against forces of the law itself."""
    model = anywhere(known_model(friction=Stribeck), std=0.4)
    found = {
        n: x for c in model.physical_constants() for n, x in zip(c.names, c.values, strict=True)
    }
    law, slide = model.friction, model.structure.joint_names.index("slide")
    fast = torch.full((4,), 1e3).double()
    assert float(law(fast)[slide]) == pytest.approx(
        float(found["Coulomb friction (v > 0) of slide"])
    )
    assert float(law(-fast)[slide]) == pytest.approx(
        -float(found["Coulomb friction (v < 0) of slide"])
    )
    # Near rest F = (c + s) v / w, with c of the direction.
    slow = torch.full((4,), 1e-9).double()
    slope = law.slope(slow)[slide]
    level = found["Coulomb friction (v > 0) of slide"] + found["Stribeck rise of slide"]
    width = float(found["friction width of slide"])
    assert width == pytest.approx(float(level / slope), rel=1e-6)
    assert width > 0.01
