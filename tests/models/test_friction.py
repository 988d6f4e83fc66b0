"""Dry friction is passive for every parameter, and reports the constants that act."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pinn_dyn.models import (
    AsymmetricCoulomb,
    CoulombFriction,
    NoFriction,
    Stribeck,
)
from pinn_dyn.testing import FrictionContract
from tests.models.builders import make_scales, perturb
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
