"""The soft arm as a mechanical system: bent, straight, with one to three segments."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pinn_dyn.systems import SoftArm, TendonArm
from pinn_dyn.testing import Configurations, MechanicalSystemContract, assert_near
from tests.support.contracts import one_case, slow_except


def arm_configurations(segments, bending):
    """Bending up to ``bending`` rad, elongation from -0.05 m to 0.3 m."""
    generator = torch.Generator().manual_seed(segments)
    q, v, a, u = (
        2 * torch.rand(8, segments, 3, generator=generator, dtype=torch.float64) - 1
        for _ in range(4)
    )
    q = q * torch.tensor([bending, bending, 0.175]) + torch.tensor([0, 0, 0.125])
    return Configurations(*(x.flatten(1) for x in (q, v, a, 0.5 * u)))


@one_case
class TestBentSoftArm(MechanicalSystemContract):
    # The straight one below has two.
    @pytest.fixture(params=slow_except([1, 3], [1]), ids=["one", "three"])
    def system(self, request):
        return SoftArm(request.param)

    @pytest.fixture
    def configurations(self, system):
        return arm_configurations(system.segments, bending=1.2)


@one_case
class TestStraightSoftArm(MechanicalSystemContract):
    """At theta = 0, where a formula that divides by theta would fail."""

    @pytest.fixture
    def system(self):
        return SoftArm(2)

    @pytest.fixture
    def configurations(self, system):
        return arm_configurations(system.segments, bending=0.0)


@one_case
class TestTendonArm(MechanicalSystemContract):
    """Taut and slack tendons, with dry friction."""

    @pytest.fixture(
        params=slow_except([(1, 4), (2, 3)], [(2, 3)]), ids=["four-tendons", "two-segments"]
    )
    def system(self, request):
        segments, tendons = request.param
        friction = (0.02, 0.02, 0.1)
        speed = (0.5, 0.5, 0.5)
        return TendonArm(
            segments,
            tendons=tendons,
            friction=friction,
            friction_speed=speed,
            tendon_stiffness=20.0,
        )

    @pytest.fixture
    def configurations(self, system):
        return arm_configurations(system.segments, bending=0.8)._replace(
            u=arm_configurations(system.segments, 0.8).u[:, :1].expand(8, system.num_inputs).clone()
        )


def test_tendons_pull_along_their_measured_lengths():
    """Against lengths of offset curves by numerical integration, and the law of a taut tendon."""
    arm = TendonArm(2, radius=0.03)
    q = torch.tensor([0.5, -0.3, 0.02, -0.4, 0.6, -0.03], dtype=torch.float64)
    lengths = []
    for segment in range(2):
        for angle in 2 * np.pi / 3 * np.arange(3):
            length = 0.0
            for dx, dy, dl in q.numpy().reshape(2, 3)[: segment + 1]:
                s = np.linspace(0, 1, 20_001)
                turns = Rotation.from_rotvec(s[:, None] * [-dy, dx, 0]).as_matrix()
                tangents = (0.2 + dl) * turns[:, :, 2]
                centre = np.concatenate(
                    [np.zeros((1, 3)), np.cumsum(tangents[1:] + tangents[:-1], 0) / 2 / 20_000]
                )
                offset = 0.03 * np.array([np.cos(angle), np.sin(angle), 0])
                path = centre + turns @ offset
                length += np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
            lengths.append(length - 0.2 * (segment + 1))
    u = torch.linspace(-1, 2, 6).double()
    assert_near(arm.routing @ q, torch.tensor(lengths), 1e-6)
    stretch = np.array(lengths) + 0.02 * u.numpy() + 10 / 1000
    tension = arm.tensions(q, u).numpy()
    taut = stretch > 0.01
    assert taut.any()
    assert not taut.all()
    assert np.allclose(tension[taut], 1000 * stretch[taut], rtol=1e-3)
    assert (tension[stretch < -0.01] < 0.02).all()
