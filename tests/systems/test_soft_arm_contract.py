"""The soft arm as a mechanical system: bent, straight, with one to three segments."""

import pytest
import torch

from pinn_dyn.systems import SoftArm
from pinn_dyn.testing import Configurations, MechanicalSystemContract


def arm_configurations(segments, bending):
    """Bending up to ``bending`` rad, elongation from -0.05 m to 0.3 m."""
    generator = torch.Generator().manual_seed(segments)
    q, v, a, u = (
        2 * torch.rand(8, segments, 3, generator=generator, dtype=torch.float64) - 1
        for _ in range(4)
    )
    q = q * torch.tensor([bending, bending, 0.175]) + torch.tensor([0, 0, 0.125])
    return Configurations(*(x.flatten(1) for x in (q, v, a, 0.5 * u)))


class TestBentSoftArm(MechanicalSystemContract):
    # The straight one below has two.
    @pytest.fixture(params=[1, 3], ids=["one", "three"])
    def system(self, request):
        return SoftArm(request.param)

    @pytest.fixture
    def configurations(self, system):
        return arm_configurations(system.segments, bending=1.2)


class TestStraightSoftArm(MechanicalSystemContract):
    """At theta = 0, where a formula that divides by theta would fail."""

    @pytest.fixture
    def system(self):
        return SoftArm(2)

    @pytest.fixture
    def configurations(self, system):
        return arm_configurations(system.segments, bending=0.0)
