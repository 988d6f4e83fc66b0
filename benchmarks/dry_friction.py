"""Dry friction at rest here and in MuJoCo, and the cost of sticking with hardly any friction.

    python -m benchmarks.dry_friction

The double pendulum of the examples has Coulomb friction, and no other one. It starts at rest at
(0.3, 0.2) rad. With a friction of 2 Nm, more than its weight, it stays there for 10 s, here and as
its exported MJCF in MuJoCo, both in steps of 1 ms. With a friction of 1e-6 Nm it falls for 1 s in
steps of 1 ms, with and without sticking. The reference has the smooth law and steps of 0.2 ms.
"""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path

import mujoco
import torch
from torch import Tensor

from pinn_dyn.mechanics import Signal, double_copy
from pinn_dyn.models import CoulombFriction, KnownMechanics, Statistics
from pinn_dyn.run.export import export
from pinn_dyn.systems import RigidChain

URDF = Path(__file__).parents[1] / "examples" / "double_pendulum.urdf"
STEP = 1e-3  # s


def pendulum(level: float, sticking: bool) -> KnownMechanics:
    """Return the pendulum with a dry friction in Nm, and all but no other resistance."""
    one, scales = torch.ones(2), torch.ones(1, 4)
    statistics = Statistics(0 * one, one, -one, one, one, one, 0 * one, one, scales, scales, STEP)
    friction = partial(CoulombFriction, level=level, sticking=sticking)
    model = double_copy(KnownMechanics(statistics, RigidChain(str(URDF)), friction=friction))
    with torch.no_grad():
        for constants in (model.armature, model.viscous):
            constants.z.fill_(-20.0)
    return model.requires_grad_(False)


def moved(model: KnownMechanics, q0: Tensor, duration: float, step: float) -> Tensor:
    """Return the states of a motion from rest without input."""
    t = torch.arange(round(duration / step) + 1).double() * step
    return model.predict(torch.cat([q0, 0 * q0]), t, Signal(t, torch.zeros(len(t), 2).double()))


def crept_in_mujoco(model: KnownMechanics, q0: Tensor, duration: float) -> float:
    """Return the largest change of an angle in MuJoCo, rad."""
    with tempfile.TemporaryDirectory() as folder:
        robot = mujoco.MjModel.from_xml_path(str(export(model, Path(folder) / "arm.xml")))
    robot.opt.timestep = STEP
    data = mujoco.MjData(robot)
    data.qpos[:] = q0
    mujoco.mj_step(robot, data, round(duration / STEP))
    return float(abs(data.qpos - q0.numpy()).max())


def main() -> None:
    q0 = torch.tensor([0.3, 0.2]).double()
    model = pendulum(2.0, sticking=True)
    here = float((moved(model, q0, 10.0, STEP)[:, :2] - q0).abs().max())
    there = crept_in_mujoco(model, q0, 10.0)
    print(f"at rest for 10 s: {here:.1e} rad here, {there:.1e} rad in MuJoCo")
    exact = moved(pendulum(1e-6, sticking=False), q0, 1.0, STEP / 5)[::5]
    for sticking in (True, False):
        error = (moved(pendulum(1e-6, sticking), q0, 1.0, STEP) - exact).abs().max()
        print(f"friction of 1e-6 Nm, sticking {sticking}: error {float(error):.1e} within 1 s")


if __name__ == "__main__":
    main()
