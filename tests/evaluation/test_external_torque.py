"""External torques of an arm whose torques Pinocchio computes, with stiction and noise."""

from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch

import pinn_dyn
from pinn_dyn.evaluation.external_torque import (
    contact_thresholds,
    link_wrench,
    observed_torques,
    settled,
)
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.systems.urdf import read_urdf
from pinn_dyn.training import LeastSquares
from tests.models.builders import VARIANTS, make_structured
from tests.support.c_code import function_of
from tests.support.known import motion

pinocchio = pytest.importorskip("pinocchio", reason="the dev extra is not installed")

PANDA, TOOL = "franka_panda/panda.urdf", "panda_hand"
JOINTS = ["panda_joint1", "panda_joint2", "panda_joint4"]
NAMES = [[f"{signal}{k}" for k in range(3)] for signal in ("q", "v", "tau")]
FORCE = np.array([6.0, -9.0, 8.0])
BANDWIDTH, RATE = 25.0, 200.0
VISCOUS, DRY = np.array([2.0, 2.0, 1.0]), np.array([1.5, 2.0, 0.8])


def reduced():
    """The Panda with three joints in Pinocchio, the others at zero, and the frame of its tool."""
    text = read_urdf(PANDA).path
    whole = pinocchio.buildModelFromUrdf(str(text))
    locked = [whole.getJointId(name) for name in list(whole.names)[1:] if name not in JOINTS]
    model = pinocchio.buildReducedModel(whole, locked, pinocchio.neutral(whole))
    return model, model.getFrameId(TOOL)


def log(seed, seconds, contact=None):
    """A log of sines with pauses, in which dry friction takes all levels, and a force at the tool.

    ``contact`` is the start of a push of 0.3 s, s. Noise of 1 mrad/s and 0.05 Nm.
    """
    model, tool = reduced()
    data, generator = model.createData(), np.random.default_rng(seed)
    t = np.arange(int(seconds * RATE)) / RATE
    phase = (t[:, None] + generator.uniform(0, 5, 3)) % 5
    ramp = np.clip(np.minimum(phase, 4 - phase) / 0.3, 0, 1)  # 1 s of rest in 5 s
    ramp = ramp**2 * (3 - 2 * ramp)
    path, q, v = np.cumsum(ramp, axis=0) / RATE, 0.0, 0.0
    for w in 2 * np.pi * np.array([0.11, 0.23, 0.41, 0.67]):
        angle = w * path + generator.uniform(0, 6, 3)
        q, v = q + 0.4 / w * np.sin(angle), v + 0.4 * np.cos(angle) * ramp
    q += np.array([0.0, 0.4, -1.6])
    a = np.gradient(v, 1 / RATE, axis=0)
    # At rest, the drive shifts the dry friction slowly to the one of the next motion.
    moving = pd.DataFrame(np.sign(v)).where(ramp > 0)
    sign = moving.interpolate(limit_direction="both").to_numpy()
    tau = np.array([pinocchio.rnea(model, data, *row) for row in zip(q, v, a, strict=True)])
    tau += VISCOUS * v + DRY * sign
    if contact is not None:
        axes = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        for k in np.flatnonzero((t >= contact) & (t < contact + 0.3)):
            J = pinocchio.computeFrameJacobian(model, data, q[k], tool, axes)
            tau[k] -= J[:3].T @ FORCE
    v = v + 1e-3 * generator.normal(size=v.shape)
    tau = tau + 0.05 * generator.normal(size=tau.shape)
    columns = [name for signal in NAMES for name in signal]
    return pd.DataFrame(np.hstack([q, v, tau]), columns=columns).assign(t=t)


@pytest.fixture(scope="module")
def run():
    structure = RigidChain(PANDA, joints=JOINTS)
    model = partial(KnownMechanics, structure=structure, friction=CoulombFriction)
    q, v, u = NAMES
    solver = LeastSquares(cutoff=6.0, rollouts=False)
    return pinn_dyn.fit(log(0, 60.0), q=q, v=v, u=u, model=model, optimizer=solver)


def test_a_push_at_the_tool_is_found_with_its_force(run):
    start = 7.0
    frame = log(1, 12.0, contact=start)
    result = run.external_torque(frame, bandwidth=BANDWIDTH, link=TOOL)
    assert len(result.contacts) == 1
    contact = result.contacts.iloc[0]
    assert 0 <= contact.start - start < 0.5 / BANDWIDTH + 2 / RATE
    assert 0.3 <= contact.end - start < 0.3 + 3 / BANDWIDTH
    pushed = result.table[(frame.t > start + 3 / BANDWIDTH) & (frame.t < start + 0.3)]
    force = pushed[["fx", "fy", "fz"]].to_numpy()
    error = np.linalg.norm(force - FORCE, axis=1) / np.linalg.norm(FORCE)
    assert error.max() < 0.1
    assert not pushed.ambiguous.any()


def rolled(frame, columns, change):
    return frame.assign(**dict(zip(columns, change(frame[columns].to_numpy()).T, strict=True)))


def test_frames_whose_quiet_part_does_not_fit_the_model_are_named(run, caplog):
    """A push of half of the time is fine."""
    q, v, u = NAMES
    frame = log(1, 12.0, contact=7.0)
    pushed = rolled(
        frame, u, lambda x: x - np.array([3.0, 5.0, 2.0]) * (frame.t.to_numpy()[:, None] > 6)
    )
    wrong = {
        "reversed": rolled(frame, u, np.negative),
        "one reversed": rolled(frame, u[2:], np.negative),
        "mNm": rolled(frame, u, lambda x: 1000 * x),
        "degrees": rolled(rolled(frame, q, np.rad2deg), v, np.rad2deg),
        "exchanged": rolled(frame, u[:2], np.fliplr),
        "homed elsewhere": rolled(frame, q[1:2], lambda x: x + 0.2),
        "offset": rolled(frame, u[1:2], lambda x: x + 3),
        "50 ms late": rolled(frame, u, lambda x: np.roll(x, 10, 0)),
    }
    for name, x in {"right": frame, "pushed": pushed, **wrong}.items():
        caplog.clear()
        result = run.external_torque(x, bandwidth=BANDWIDTH)
        assert bool(result.doubtful) == (name in wrong), name
        assert ("even its quiet part" in caplog.text) == (name in wrong), name


def test_a_minute_of_free_motion_gives_no_alarm(run):
    result = run.external_torque(log(2, 60.0), bandwidth=BANDWIDTH)
    assert result.contacts.empty
    assert not result.table.contact.any()
    assert (result.threshold < 1.5).all()


def test_stiction_is_no_external_torque(run):
    """Thresholds contain all friction levels if the friction at rest is left out."""
    quiet = run.source.load().validation

    def thresholds():
        step = float(quiet[0].t[1] - quiet[0].t[0])
        sizes = (observed_torques(run.system, x, BANDWIDTH)[0] for x in quiet)
        sizes = [settled(x, step, BANDWIDTH) for x in sizes]
        return contact_thresholds(sizes, step, BANDWIDTH, 1.0)

    with_rest = thresholds()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pinn_dyn.evaluation.external_torque.rest_speeds", lambda model: None)
        without = thresholds()
    assert (with_rest < 0.5 * without).all()


def test_the_wrench_at_a_link_repeats_the_torques_of_a_force_and_moment():
    chain = RigidChain(
        PANDA, locked_joints=["panda_finger_joint1", "panda_finger_joint2"], tip=TOOL
    )
    q = torch.tensor([[0.3, 0.5, -0.2, -1.5, 0.4, 1.4, 0.2]], dtype=torch.float64)
    whole = pinocchio.buildModelFromUrdf(str(chain.tree.path))
    data, axes = whole.createData(), pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
    configuration = np.append(q.numpy()[0], [0, 0])
    J = pinocchio.computeFrameJacobian(whole, data, configuration, whole.getFrameId(TOOL), axes)
    np.testing.assert_allclose(chain.tip_jacobian(q)[0], J[:, :7], atol=1e-12)
    wrench = np.array([3.0, -5.0, 2.0, 0.4, 0.1, -0.6])
    torque = torch.from_numpy(J[:, :7].T @ wrench)[None]
    result, ambiguous = link_wrench(chain, q, torque, moment=True)
    np.testing.assert_allclose(result[0], wrench, rtol=0.05, atol=0.05)
    assert not ambiguous.any()
    stretched = torch.zeros_like(q)
    assert link_wrench(chain, stretched, torque, moment=True)[1].all()


def test_a_force_that_no_joint_feels_is_ambiguous_instead_of_not_a_number():
    """The origin of a link on the axis of its joint."""
    chain = RigidChain(PANDA, joints=JOINTS, tip="panda_link1")
    q = torch.rand(4, 3, generator=torch.Generator().manual_seed(0)).double()
    assert not chain.tip_jacobian(q)[:, :3].any()
    force, ambiguous = link_wrench(chain, q, torch.ones_like(q), moment=False)
    assert not force.any()
    assert ambiguous.all()


def test_a_held_input_acts_until_the_next_sample():
    """A free mass under steps of its input: momentum grows by the held input exactly."""
    chain = RigidChain(PANDA, joints=JOINTS[:1], gravity=[0.0, 0.0, 0.0])
    t = torch.arange(50, dtype=torch.float64) / RATE
    u = torch.where(t > 0.1, 2.0, -1.0).to(t)[:, None]
    inertia = float(chain.mass_matrix(torch.zeros(1, dtype=torch.float64)))
    rate = torch.cat([torch.zeros(1, 1), u[:-1]]).cumsum(0) / RATE / inertia
    hold = Trajectory(0 * rate, rate, Signal(t, u, "hold"))
    line = Trajectory(0 * rate, rate, Signal(t, u, "linear"))
    assert observed_torques(chain, hold, BANDWIDTH)[0].abs().max() < 1e-9
    assert observed_torques(chain, line, BANDWIDTH)[0].abs().max() > 0.1


def test_the_c_function_gives_the_torques_of_the_log(run, tmp_path, few_states):
    path = run.export(tmp_path / "contact.c", "external_torque")
    call = function_of(path, "contact_external_torque")
    frame = log(1, 2.0, contact=0.5)
    q, v, u = (frame[names].to_numpy() for names in NAMES)
    motion = Trajectory(
        *map(torch.from_numpy, (q, v)),
        Signal(torch.arange(len(q)).double() / RATE, torch.tensor(u)),
    )
    expected = observed_torques(run.system, motion, BANDWIDTH)[0]
    memory, results = np.zeros(16), []
    for row in zip(q, v, u, strict=True):
        torque, memory = call(*row, BANDWIDTH, 1 / RATE, memory)
        results.append(torque)
    np.testing.assert_allclose(results, expected, atol=1e-9 * float(expected.abs().max()))


@pytest.mark.parametrize("kind", ["lnn", "hnn"])
def test_the_torques_of_a_network_on_its_own_motion_are_those_of_the_push(kind):
    """The motion is that of the same model with a constant force in its first coordinate."""
    model = make_structured(kind, **VARIANTS["constant-mass-fixed-damping-constant-input-3x3"])
    model = model.double().requires_grad_(False)
    path = motion(model, seconds=0.5, rate=500.0)
    push = torch.tensor([0.7, 0.0, 0.0]).double()
    if kind == "hnn":  # its state is (q, p)
        path = Trajectory(path.q, model.velocity(path.q, path.v), path.input)
    missing = torch.linalg.solve(model.input_matrix(path.q), push.expand_as(path.q))
    seen = Trajectory(path.q, path.v, Signal(path.t, path.u - missing))
    residual = observed_torques(model, seen, 40.0)[0]
    expected = (1 - torch.exp(-40.0 * path.t))[:, None] * push
    assert (residual - expected).abs().max() < 2e-3
