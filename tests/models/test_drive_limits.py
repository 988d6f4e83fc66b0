"""Drives that saturate and lose torque, against a simulation in NumPy with hard limits."""

from functools import partial

import numpy as np
import pytest
import torch

from pinn_dyn.control import (
    ComputedTorque,
    Pipeline,
    PredictiveControl,
    SetPoint,
    SystemPlant,
    close_loop,
)
from pinn_dyn.control.contracts import Motion
from pinn_dyn.data.windows import draw_windows
from pinn_dyn.exports.c_file import find_compiler
from pinn_dyn.identification.constants import constants_table
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import CoulombFriction, DriveLimits, KnownMechanics, LoadDependent, Servo
from pinn_dyn.run.export import export
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares
from tests.models.builders import make_structured
from tests.support.known import known_model, statistics, unit_scales

MASS, LENGTH, VISCOUS, DRY = 1.0, 0.3, 0.15, 0.2
LIMIT, STALL, SPEED = 3.0, 6.0, 9.0
ARM = f"""<robot name="arm"><link name="base"/><link name="arm"><inertial>
    <origin xyz="0 0 -{LENGTH}"/><mass value="{MASS}"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="hinge" type="continuous"><parent link="base"/><child link="arm"/>
    <axis xyz="0 1 0"/></joint></robot>"""
INERTIA = MASS * LENGTH**2 + 0.01
DC = partial(DriveLimits, limit=LIMIT, stall=STALL, no_load_speed=SPEED)


def hard(s, v):
    ends = [min(LIMIT, max(STALL * (1 - w / SPEED), 0.0)) for w in (v, -v)]
    return min(max(s, -ends[1]), ends[0])


def recording(seed, seconds=20.0, rate=200.0, loss=0.0, scale=1.5, limited=hard):
    """Commands of a stiff controller on sines that ask for more than the drive has."""
    generator, step = np.random.default_rng(seed), 1 / rate / 5
    t = np.arange(int(seconds * rate)) / rate
    w = 2 * np.pi * np.array([0.23, 0.51, 0.97])
    phase = generator.uniform(0, 6, 3)
    goal = scale * 0.6 * np.sin(w * t[:, None] + phase).sum(1)
    q, v, rows = goal[0], 0.0, []
    for k in range(len(t)):
        u = 40 * (goal[k] - q) - 3 * v
        rows.append((q, v, u))
        for _ in range(5):
            tau = limited(u, v)
            friction = DRY * np.tanh(v / 0.02) + loss * abs(tau) * np.tanh(v / 0.02)
            gravity = MASS * 9.81 * LENGTH * np.sin(q)
            v += step * (tau - friction - VISCOUS * v - gravity) / INERTIA
            q += step * v
    q, v, u = np.array(rows).T[..., None]
    t = torch.from_numpy(t)
    signal = Signal(t, torch.from_numpy(u), "hold")
    return Trajectory(torch.from_numpy(q), torch.from_numpy(v), signal)


def fitted(motions, rollouts=False, **settings):
    windows = draw_windows(motions, count=120, steps=20, stride=2, seed=0)
    settings = {"start": "prior", "spread": 0.3, "friction": CoulombFriction, **settings}
    model = KnownMechanics(windows.statistics(), RigidChain(ARM), **settings)
    solver = LeastSquares(cutoff=8.0, rollouts=rollouts)
    fit = solver.fit(model, motions, windows if rollouts else None)
    return model, constants_table(model, fit).set_index("name")


@pytest.fixture(scope="module")
def motions():
    return [recording(seed) for seed in range(2)]


def share_saturated(motions):
    limited = [hard(s, v) != s for x in motions for s, v in zip(x.u[:, 0], x.v[:, 0], strict=True)]
    return np.mean(limited)


def test_saturated_samples_do_not_bias_the_constants(motions):
    """A third of the commands cannot be reached; m c of the arm is 0.3 kg m."""
    assert 0.1 < share_saturated(motions) < 0.5
    errors = []
    for limits in (None, DC):
        _, table = fitted(motions, limits=limits)
        values = table.value[["m cz of arm", "viscous friction of hinge"]].to_numpy()
        errors.append(abs(values / [-MASS * LENGTH, VISCOUS] - 1))
    assert (errors[1] < [0.02, 0.1]).all()
    assert (errors[0] > 1).all()


@pytest.mark.slow
def test_limits_are_learned_from_rollouts(motions):
    limits = partial(DriveLimits, limit="learned", stall="learned", no_load_speed="learned")
    model, table = fitted(motions, rollouts=True, limits=limits)
    assert table.value["torque limit of hinge"] == pytest.approx(LIMIT, rel=0.05)
    assert table.unit["no-load speed of hinge"] == "rad/s"
    force, v = torch.full((3, 1), 50.0), torch.tensor([[0.0], [5.5], [7.0]])
    largest = model.drives.limits(force, v)[:, 0].detach()
    assert largest.tolist() == pytest.approx([hard(50.0, float(x)) for x in v], abs=0.25)


def test_the_torque_is_that_of_the_curve():
    limits = DC(unit_scales(1)).double()
    force, v = (
        x.flatten()[:, None]
        for x in torch.meshgrid(
            torch.linspace(-9, 9, 37).double(), torch.linspace(-12, 12, 25).double(), indexing="ij"
        )
    )
    expected = [hard(float(s), float(w)) for s, w in zip(force, v, strict=True)]
    np.testing.assert_allclose(limits(force, v)[:, 0], expected, atol=0.05 * LIMIT)
    saturated = limits.saturated(force, v)
    torch.testing.assert_close(
        limits(force, v)[~saturated], force[~saturated], rtol=5e-3, atol=5e-3
    )


def test_derivatives_of_limits_and_losses_are_those_of_autograd():
    limits = partial(DriveLimits, limit="learned", stall="learned", no_load_speed="learned")
    model = known_model(friction=LoadDependent, gain_spread=0.3, limits=limits)
    generator = torch.Generator().manual_seed(0)
    q, v, a, u = torch.randn(4, 6, model.num_coordinates, generator=generator).double()
    at = q, v, a, 3 * u[:, : model.num_inputs]
    expected = super(type(model.slopes()), model.slopes())
    closed, automatic = model.slopes().by_parameters(*at), expected.by_parameters(*at)
    torch.testing.assert_close(closed, automatic)
    assert (closed[..., -3 * len(model.driven) :].abs().amax((0, 1)) > 0).any()


def test_a_law_asks_for_what_the_drive_has():
    model = KnownMechanics(statistics(1), RigidChain(ARM), limits=DC).double()
    model.requires_grad_(False)
    law = ComputedTorque(model, 100.0, 20.0)
    at = torch.zeros(2, 1).double()
    goal = Motion(torch.tensor([[0.02], [2.0]]).double(), 0 * at, 0 * at)
    pipeline = Pipeline(law)
    memory = torch.zeros(*at.shape[:-1], pipeline.memory_size).double()
    u, status, _ = pipeline(at, at, *goal, memory)
    torque = model.motor_force(at, at, u)
    assert float(torque[0, 0]) == pytest.approx(
        float(model.inverse_dynamics(at, at, 100 * goal.q)[0, 0])
    )
    assert float(torque[1, 0]) == pytest.approx(0.98 * LIMIT, rel=1e-3)
    assert not status.any()


def test_a_plan_keeps_within_the_drive():
    """The arm moves to 1 rad under the hard limits; all commands are torques that it has."""
    pytest.importorskip("casadi", reason="the mpc extra is not installed")
    model = KnownMechanics(statistics(1), RigidChain(ARM), limits=DC).double()
    model.requires_grad_(False)
    law = PredictiveControl(model, 0.5, 0.02, velocity_weight=0.01, input_weight=1e-3)
    rest = torch.zeros(1, 1).double()
    record = close_loop(
        SystemPlant(model), law, SetPoint([1.0]), rest, rest, duration=2.0, rate=50.0
    )
    assert record.u.abs().max() <= LIMIT
    assert record.u.abs().max() > 0.99 * LIMIT
    assert record.diagnostics["solver_failed"].mean() < 0.05
    assert abs(float(record.q[0, -1]) - 1.0) < 0.02


def test_an_mjcf_has_the_limit_at_rest(tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="the mujoco extra is not installed")
    model = KnownMechanics(statistics(1), RigidChain(ARM), limits=DC).requires_grad_(False)
    robot = mujoco.MjModel.from_xml_path(str(export(model, tmp_path / "arm.xml")))
    assert robot.actuator_forcerange[0].tolist() == pytest.approx([-LIMIT, LIMIT])


@pytest.mark.skipif(not find_compiler(), reason="no C compiler")
def test_files_in_c_have_the_limits(tmp_path):
    model = KnownMechanics(statistics(1), RigidChain(ARM), limits=DC, friction=LoadDependent)
    path = export(model.requires_grad_(False), tmp_path / "arm.c", "forward_dynamics")
    assert path.stat().st_size > 1000  # compared at 200 states


def test_friction_that_grows_with_the_load_is_identified():
    """The loss of 15 % is found by the columns sign(v) |tau| of the inverse dynamics."""
    motions = [recording(k, loss=0.15, scale=0.5, limited=lambda s, v: s) for k in range(2)]
    _, table = fitted(motions, friction=LoadDependent, spread=0.05)
    row = table.loc["loss by load of hinge"]
    assert row.value == pytest.approx(0.15, abs=0.02)
    assert row.low < 0.15 < row.high


@pytest.mark.parametrize("loss", [0.15, 0.0])
def test_a_loss_stays_only_if_it_predicts_better(loss, caplog):
    """The errors of predictions over 0.3 s decide."""
    caplog.set_level("INFO")
    motions = [recording(k, loss=loss, scale=0.5, limited=lambda s, v: s) for k in range(3)]
    windows = draw_windows(motions[2:], count=60, steps=60, stride=1, seed=0)

    def validate(model):
        start = windows.start("qv")
        with torch.no_grad():
            moved = model.predict(start, windows.t, windows.input)[:, 1:] - start[:, None]
        error = (moved - windows.increments("qv"))[..., 0]
        return error.square().mean(1).sqrt().unflatten(0, (12, 5)).mean(1)

    train = draw_windows(motions, count=20, steps=2, stride=1, seed=0)
    settings = {"start": "prior", "spread": 0.05, "friction": LoadDependent}
    model = KnownMechanics(train.statistics(), RigidChain(ARM), **settings)
    fit = LeastSquares(cutoff=8.0, rollouts=False).fit(model, motions[:2], validate=validate)
    table = constants_table(model, fit).set_index("name")
    if loss:
        assert table.value["loss by load of hinge"] == pytest.approx(loss, abs=0.02)
        assert "keeps loss by load of hinge" in caplog.text
    else:
        assert table.value["loss by load of hinge"] < 0.02
    assert table.value["m cz of arm"] == pytest.approx(-MASS * LENGTH, rel=0.03)


def test_wrong_limits_are_refused():
    with pytest.raises(ValueError, match="stall and no_load_speed together"):
        DriveLimits(unit_scales(1), stall=3.0)
    with pytest.raises(ValueError, match="friction with a loss by load needs known drives"):
        make_structured("lnn", friction=LoadDependent)
    with pytest.raises(ValueError, match=r"leave out model\.limits"):
        KnownMechanics(statistics(1), RigidChain(ARM), limits=DC, input=Servo)
