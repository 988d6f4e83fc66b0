"""PyBullet arms: Bullet's own steps are those of the equation of motion."""

import numpy as np
import pytest
import torch

from pinn_dyn.systems import BulletArm
from tests.support.bullet_arms import FINGERS, PANDA, states

pytest.importorskip("pybullet", reason="PyBullet is not installed (the panda extra)")
pytestmark = pytest.mark.panda


def check_steps(q, v, u, arm):
    a = arm.forward_dynamics(*(torch.from_numpy(x[:-1]) for x in (q, v, u))).numpy()
    assert np.abs(a).max() > 5  # so 1e-8 is a statement about the motion
    np.testing.assert_allclose(v[1:], v[:-1] + 1e-3 * a, rtol=0, atol=1e-8)
    np.testing.assert_allclose(q[1:], q[:-1] + 1e-3 * v[1:], rtol=0, atol=1e-12)


@pytest.mark.parametrize("change", [{"payload": 3.0}, {"mass_scale": 1.3}])
@pytest.mark.parametrize("inertia", ["file", "collision"])
def test_recorded_steps_of_a_changed_arm(inertia, change):
    arm = BulletArm(PANDA, locked_joints=FINGERS, inertia=inertia, damping=0, **change)
    q0, v0, _ = states(arm, 1)
    check_steps(*arm.simulate(q0[0], v0[0], lambda k, q, v: 3 + 0 * q, steps=40, step=1e-3), arm)


def test_copies_stepped_in_turn_move_as_if_alone(panda):
    """Bullet keeps nothing of an earlier copy, nor of an arm whose damping alone differs."""
    rng = np.random.default_rng(3)
    q0, v0, _ = states(panda, 3)
    torques = rng.uniform(-10, 10, (3, 41, 7))
    arms = [panda, panda, BulletArm(PANDA, locked_joints=FINGERS, damping=2.0)]
    alone = [
        arm.simulate(q0[i], v0[i], lambda k, q, v, i=i: torques[i, k], steps=40, step=1e-3)
        for i, arm in enumerate(arms)
    ]
    q, v = q0.copy(), v0.copy()
    for k in range(40):
        for i, arm in enumerate(arms):
            arm.set_state(q[i], v[i])
            q[i], v[i] = arm.step(torques[i, k], 1e-3)
            np.testing.assert_array_equal(q[i], alone[i][0][k + 1])
            np.testing.assert_array_equal(v[i], alone[i][1][k + 1])


def test_several_steps_from_one_state_and_a_law_that_looks_at_the_arm(panda):
    (q0, *_), (v0, *_), _ = states(panda)
    torque = np.full(7, 2.0)

    def law(k, q, v):
        elsewhere = torch.zeros(7, dtype=torch.float64)
        panda.potential_energy(elsewhere), panda.tip_position(elsewhere)
        panda.dynamics(0 * q, v), panda.tip_jacobian(elsewhere)
        return torque

    panda.set_state(q0, v0)
    stepped = [panda.step(law(k, q0, v0), 1e-3) for k in range(20)]
    q, v, _ = panda.simulate(q0, v0, lambda k, q, v: torque, steps=20, step=1e-3)
    np.testing.assert_array_equal(np.array([x for x, _ in stepped]), q[1:])
    np.testing.assert_array_equal(np.array([x for _, x in stepped]), v[1:])
    again, _, _ = panda.simulate(q0, v0, law, steps=20, step=1e-3)
    np.testing.assert_array_equal(again, q)


@pytest.mark.parametrize("damping", [0.0, 2.0])
@pytest.mark.parametrize("inertia", ["file", "collision"])
def test_recorded_steps_are_those_of_the_equation_of_motion(inertia, damping):
    """Also far beyond the joint and velocity limits of the URDF, where nothing may stop it."""
    arm = BulletArm(PANDA, locked_joints=FINGERS, inertia=inertia, damping=damping)
    rng = np.random.default_rng(1)
    torques = rng.uniform(-5, 5, (61, 7)) * np.array([4, 4, 4, 4, 1, 1, 1])
    q, v, u = arm.simulate(
        arm.q_high + 0.5, 2 * arm.v_max, lambda k, q, v: torques[k], steps=60, step=1e-3
    )
    np.testing.assert_array_equal(u, torques)
    check_steps(q, v, u, arm)


def test_pendulum_swings_without_walls_and_friction_and_keeps_its_energy(pendulum):
    """Released at 1.2 rad between walls at 0.1 rad and with friction in the URDF."""
    arm = BulletArm(pendulum(), damping=0)
    zero = np.zeros(2)
    q, v, _ = arm.simulate(np.array([1.2, 0.4]), zero, lambda k, q, v: zero, steps=20000, step=1e-4)
    assert q[:, 0].min() < -0.5
    assert np.abs(v).max() > 2
    energy = arm.total_energy(torch.from_numpy(q[::100]), torch.from_numpy(v[::100])).numpy()
    # Semi-implicit Euler: the error is of first order in the step and does not accumulate.
    assert np.abs(energy - energy[0]).max() < 2e-3 * (energy.max() - energy.min() + 10)
    lossy = BulletArm(pendulum(), damping=0.5)
    q, v, _ = lossy.simulate(q[0], zero, lambda k, q, v: zero, steps=20000, step=1e-4)
    lost = 0.5 * (v**2).sum(-1).mean() * 2.0
    change = lossy.total_energy(torch.from_numpy(q[[0, -1]]), torch.from_numpy(v[[0, -1]])).diff()
    assert lost > 1
    assert float(change) == pytest.approx(-lost, rel=2e-3)


def test_no_motor_resists_and_bodies_do_not_touch(panda):
    """Without gravity, torque and damping the velocity at rest stays zero, folded up as well."""
    arm = BulletArm(PANDA, locked_joints=FINGERS, inertia="collision", damping=0, gravity=(0, 0, 0))
    folded = np.array([0, 1.8, 0, -3.1, 0, 3.8, 0])
    _, v, _ = arm.simulate(folded, 0 * folded, lambda k, q, v: 0 * q, steps=50, step=1e-3)
    assert np.abs(v).max() < 1e-12
