"""Robots with a joint without a motor: no constant collapses, and the defaults find all of them."""

import copy
from functools import partial

import pytest
import torch

import pinn_dyn
from pinn_dyn.control import Motion, Regulation
from pinn_dyn.data import draw_windows
from pinn_dyn.identification.constants import constants_table, undetermined
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.models.learned_constants import Slopes
from pinn_dyn.systems import RigidChain
from pinn_dyn.testing.controller import input_of
from pinn_dyn.training import LeastSquares
from tests.support.underactuated import (
    ACROBOT,
    CART_POLE,
    GRAVITY,
    PENDUBOT,
    RATE,
    fitted_constants,
    log,
)

ROBOTS = {"cart-pole": CART_POLE, "pendubot": PENDUBOT, "acrobot": ACROBOT}


def builder(arm, **settings):
    return partial(
        KnownMechanics,
        structure=RigidChain(arm.urdf),
        friction=CoulombFriction,
        driven_joints=[arm.driven],
        **settings,
    )


def recorded(arm, count):
    """Motions of a log as trajectories."""
    runs = []
    for _, run in log(arm, count).groupby("run"):
        t, q, v, u = (
            torch.from_numpy(run[columns].to_numpy().copy())
            for columns in ("t", ["q1", "q2"], ["v1", "v2"], ["u"])
        )
        runs.append(Trajectory(q, v, Signal(t, u)))
    return runs


def assert_found(arm, model, error):
    for name, value in fitted_constants(arm, model).items():
        assert value == pytest.approx(arm.constants[name], rel=error), name


@pytest.mark.parametrize("name", ["cart-pole", "pendubot"])
def test_a_joint_without_a_motor_does_not_collapse(name):
    """Zero bodies would explain zero torque."""
    arm = ROBOTS[name]
    runs = recorded(arm, 2)
    windows = draw_windows(runs, count=40, steps=1, stride=4, seed=0)
    model = builder(arm)(statistics=windows.statistics())
    LeastSquares(cutoff=10.0, rollouts=False, samples=800).fit(model, runs)
    assert_found(arm, model.double(), 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_the_defaults_find_the_constants(name):
    arm = ROBOTS[name]
    run = pinn_dyn.fit(
        log(arm, 6),
        q=["q1", "q2"],
        v=["v1", "v2"],
        u=["u"],
        run="run",
        model=builder(arm),
        optimizer=LeastSquares(cutoff=6.0),
    )
    assert_found(arm, run.model.double(), 0.1)


@pytest.fixture(scope="module")
def acrobot():
    """Three motions of the acrobot, and a model that is fitted to two of them."""
    runs = recorded(ACROBOT, 3)
    windows = draw_windows(runs[:2], count=40, steps=4, stride=4, seed=0)
    model = builder(ACROBOT, start="generic")(statistics=windows.statistics())
    fit = LeastSquares(cutoff=10.0, samples=600).fit(model, runs[:2], windows)
    return model.double(), fit, runs


def test_constants_of_an_acrobot_lie_in_their_intervals(acrobot):
    model, fit, _ = acrobot
    assert_found(ACROBOT, model, 0.1)
    table = constants_table(model, fit, ["Nm"]).set_index("name")
    names = {
        "m cz of lower": -ACROBOT.constants["lower weight"] / GRAVITY,
        "Iyy of lower": ACROBOT.constants["lower"],
        "viscous friction of shoulder": ACROBOT.viscous[0],
        "Coulomb friction of shoulder": ACROBOT.dry[0],
    }
    assert "armature of elbow" in table.index
    assert not {"armature of shoulder", "torque offset of shoulder"} & {*table.index}  # no motor
    for name, true in names.items():
        row = table.loc[name]
        assert row.known > 0.9, name
        assert row.low <= true <= row.high, name
        assert row.high - row.low < 0.25, name
    assert undetermined(model, fit)


def test_an_acrobot_is_predicted_on_another_motion(acrobot):
    """Over a second, from starts half a second apart."""
    model, _, (*_, run) = acrobot
    starts = range(0, len(run.t) - RATE, RATE // 2)
    q, v, u = (torch.stack([x[k : k + RATE + 1] for k in starts]) for x in (run.q, run.v, run.u))
    t = run.t[: RATE + 1]
    with torch.no_grad():
        found = model.predict(torch.cat([q[:, 0], v[:, 0]], -1), t, Signal(t, u))[..., :2]
    error = (found - q).norm(dim=-1).mean(1)
    assert float(error.median()) < 0.1 * float(q.std(1).norm(dim=-1).median())


def test_laws_use_what_an_acrobot_drives(acrobot):
    model, q = copy.deepcopy(acrobot[0]), torch.tensor([[0.3, 0.4]]).double()
    law = Regulation(model, 5.0, 1.0)
    u = input_of(law, q, 0 * q, Motion(q, 0 * q, 0 * q))
    force = model.potential_force(q)[:, 1:] / model.drive_gain()[1]
    torch.testing.assert_close(u, force)


def test_fewer_inputs_than_joints_need_the_names_of_the_driven_joints(acrobot):
    statistics = draw_windows(acrobot[2], count=9, steps=1, stride=1, seed=0).statistics()
    with pytest.raises(ValueError, match=r"2 coordinates and 1 inputs.*driven_joints"):
        KnownMechanics(statistics, RigidChain(ACROBOT.urdf))
    with pytest.raises(ValueError, match="driven_joints"):
        KnownMechanics(statistics, RigidChain(ACROBOT.urdf), driven_joints=["wrist"])


def test_slopes_of_passive_joints_are_those_of_the_force(acrobot):
    model = copy.deepcopy(acrobot[0])
    q, v, a = torch.randn(3, 4, 2, generator=torch.Generator().manual_seed(0)).double()
    at = (q, v, a, v[:, :1])
    torch.testing.assert_close(
        model.slopes().by_parameters(*at), Slopes(model).by_parameters(*at), rtol=1e-6, atol=1e-9
    )
    torch.testing.assert_close(model.slopes().by_state(*at), Slopes(model).by_state(*at))
    torch.testing.assert_close(model.slopes().gain(), Slopes(model).gain())
