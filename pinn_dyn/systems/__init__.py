"""Analytic and simulated robots, the ground truth of learned models."""

from pinn_dyn.systems.bullet_arm import BulletArm
from pinn_dyn.systems.mujoco_arm import MujocoArm
from pinn_dyn.systems.protocols import Drawable, HasDomain, HasLimits, HasTip, Stepped
from pinn_dyn.systems.rigid_chain import RigidChain
from pinn_dyn.systems.simulated_arm import SimulatedArm
from pinn_dyn.systems.soft_arm import SoftArm
from pinn_dyn.systems.tendon_arm import TendonArm

__all__ = [
    "BulletArm",
    "Drawable",
    "HasDomain",
    "HasLimits",
    "HasTip",
    "MujocoArm",
    "RigidChain",
    "SimulatedArm",
    "SoftArm",
    "Stepped",
    "TendonArm",
]
