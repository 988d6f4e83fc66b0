"""Every plant meets the contract."""

import pytest

from pinn_dyn.control.plants import SimulatorPlant, SystemPlant
from pinn_dyn.systems import SoftArm
from pinn_dyn.testing import PlantContract, damped_oscillators


class TestSystemPlant(PlantContract):
    @pytest.fixture(params=[damped_oscillators, SoftArm], ids=["oscillators", "soft arm"])
    def plant(self, request):
        return SystemPlant(request.param())


@pytest.mark.panda
class TestSimulatorPlant(PlantContract):
    @pytest.fixture(scope="class")
    def plant(self):
        pytest.importorskip("pybullet", reason="PyBullet is not installed (the panda extra)")
        from pinn_dyn.systems import BulletArm

        fingers = ("panda_finger_joint1", "panda_finger_joint2")
        arm = BulletArm("franka_panda/panda.urdf", locked_joints=fingers, damping=0.5)
        return SimulatorPlant(arm, step=0.001)
