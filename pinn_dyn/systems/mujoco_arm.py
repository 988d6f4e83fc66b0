"""A torque-controlled arm in MuJoCo, from any URDF or MJCF with a fixed base."""

from __future__ import annotations

import math

import numpy as np

from pinn_dyn.systems.simulated_arm import SimulatedArm


class _World:
    """A MuJoCo model of one arm, on which only gravity and the applied torques act."""

    def __init__(self, text: str, gravity: tuple[float, ...]):
        import mujoco

        self._mujoco = mujoco
        spec = mujoco.MjSpec.from_string(text)
        spec.option.gravity = gravity
        spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        moments = {}
        # The compiler refuses unphysical moments, which other simulators accept.
        for body in spec.bodies[2:]:  # after the world and the base
            moments[body.name] = body.fullinertia[:3].copy()
            body.fullinertia, body.inertia = [math.nan, 0, 0, 0, 0, 0], np.ones(3)
        model = self._model = spec.compile()
        data = self._data = mujoco.MjData(model)
        for name, values in moments.items():
            model.body(name).inertia = values
        mujoco.mj_setConst(model, data)
        # The URDF names the links by the order of their joints.
        self._joints = [model.body(f"body{k}").dofadr[0] for k in range(model.nv)]
        self.velocity = np.zeros(model.nv)

    def put(self, q: np.ndarray, v: np.ndarray) -> None:
        self._data.qpos[self._joints], self._data.qvel[self._joints] = q, v
        self.velocity = np.array(v, dtype=float)

    def step(self, force: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        self._model.opt.timestep = step
        self._data.qfrc_applied[self._joints] = force
        # mj_step would start again from zero when a motion diverges.
        self._mujoco.mj_forward(self._model, self._data)
        self._mujoco.mj_Euler(self._model, self._data)
        self.velocity = self._data.qvel[self._joints]
        return self._data.qpos[self._joints], self.velocity


class MujocoArm(SimulatedArm):
    """A :class:`~pinn_dyn.systems.simulated_arm.SimulatedArm` that MuJoCo moves."""

    simulator = "mujoco"
    install = "pip install 'pinn_dyn[mujoco]'"
    world = _World
