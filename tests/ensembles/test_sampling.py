"""Robots drawn from the posterior of their constants, against the closed form of linear forces."""

import numpy as np
import pandas as pd
import pytest
import torch

from pinn_dyn.ensembles import posterior_draws, sampled_models
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.run.run import Run
from pinn_dyn.systems import RigidChain
from pinn_dyn.systems.inertia import central_parameters
from pinn_dyn.training import LeastSquares
from tests.evaluation.test_payload import ARM, recording
from tests.support.known import known_model, statistics

COUNT = 200


@pytest.fixture(scope="module")
def fitted():
    """An arm of generic bodies with a wide prior, fitted to 20 s, the covariance and the motion."""
    pytest.importorskip("pinocchio", reason="the dev extra is not installed")
    model = KnownMechanics(
        statistics(2), RigidChain(ARM), start="generic", friction=CoulombFriction
    )
    motion = recording(0)
    solver = LeastSquares(cutoff=6.0, rollouts=False, samples=1000)
    fit = solver.fit(model, [motion])
    return model.double().requires_grad_(False), fit.covariance, motion


def states(motion):
    a = torch.gradient(motion.v, spacing=(motion.t,), dim=0)[0]
    return motion.q[::40], motion.v[::40], a[::40]


def test_all_draws_explain_the_data_and_all_bodies_can_exist(fitted):
    model, covariance, motion = fitted
    draws = sampled_models(model, covariance, COUNT, 0)
    at = states(motion)
    expected = model.inverse_dynamics(*at)
    scale = expected.std(0)
    spread, naive = (
        (torch.stack([x.inverse_dynamics(*at) for x in models]) - expected) / scale
        for models in (draws, posterior_draws(model, covariance, 20).members)
    )
    slopes = model.slopes().by_parameters(*at, 0 * at[0])
    linear = torch.einsum("knp,pr,knr->kn", slopes, covariance, slopes) / scale**2
    assert 0.7 < spread.square().mean().sqrt() / linear.mean().sqrt() < 1.2
    assert naive.square().mean().sqrt() > 10 * spread.square().mean().sqrt()
    bodies = torch.stack([x.bodies() for x in draws])
    assert (torch.linalg.eigvalsh(bodies) > 0).all()
    full = central_parameters(bodies.flatten(0, 1))[:, 4:]
    xx, xy, yy, xz, yz, zz = full.T
    matrix = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).unflatten(-1, (3, 3))
    principal = torch.linalg.eigvalsh(matrix)
    assert (principal[:, 0] + principal[:, 1] > principal[:, 2]).all()
    masses = bodies[:, :, 3, 3]
    assert (masses.std(0) > 0.05 * masses.mean(0)).all()


def test_the_common_factor_of_learned_gains_is_log_normal_about_the_fit():
    """All gains as from N(z, C), of which they are exponentials; inputs as in the data."""
    pytest.importorskip("pinocchio", reason="the dev extra is not installed")
    springs = {"springs": ["shoulder"]}
    model = KnownMechanics(
        statistics(2), RigidChain(ARM), friction=CoulombFriction, gain_spread=0.5, **springs
    )
    solver = LeastSquares(cutoff=6.0, rollouts=False, samples=1000)
    motion = recording(0)
    covariance = solver.fit(model, [motion]).covariance
    model = model.double().requires_grad_(False)
    draws = sampled_models(model, covariance, COUNT, 0)
    rows = [k for k, name in enumerate(model.parameter_names()) if "drive gain" in name]
    deviation = 0.5 * float(covariance[rows][:, rows].mean()) ** 0.5
    gains = torch.stack([(x.gain() / model.gain()).log().mean() for x in draws])
    assert deviation > 0.2
    assert float(gains.mean()) == pytest.approx(0.0, abs=3 * deviation / COUNT**0.5)
    assert float(gains.std()) == pytest.approx(deviation, rel=0.15)
    at = states(motion)
    expected, *inputs = (x.inverse_dynamics(*at) / x.drives.strength() for x in (model, *draws))
    error = (torch.stack(inputs) - expected) / expected.std(0)
    assert error.square().mean().sqrt() < 0.02


def test_the_spread_is_that_of_the_posterior_where_no_body_is_near_its_limit():
    model = known_model(friction=None, spread=0.3).requires_grad_(False)
    size = sum(x.numel() for x in model.parameters())
    generator = torch.Generator().manual_seed(1)
    root = 0.02 * torch.randn(size, size, generator=generator).double()
    covariance = root @ root.T + 1e-6 * torch.eye(size).double()
    draws = sampled_models(model, covariance, 500, 3)
    q, v, a = torch.randn(3, model.num_coordinates, generator=generator).double()
    tau = torch.stack([x.inverse_dynamics(q, v, a) for x in draws])
    model.requires_grad_(True)
    rows = torch.stack(
        [
            torch.cat(
                [
                    x.flatten()
                    for x in torch.autograd.grad(y, list(model.parameters()), retain_graph=True)
                ]
            )
            for y in model.inverse_dynamics(q, v, a)
        ]
    )
    expected = (rows @ covariance @ rows.T).diagonal().sqrt()
    assert tau.std(0).numpy() == pytest.approx(expected.numpy(), rel=0.15)
    shift = (tau.mean(0) - model.inverse_dynamics(q, v, a)).detach().abs()
    assert (shift < 0.2 * expected).all()


def test_parameters_of_bodies_are_the_inverse_of_the_bodies():
    bodies = known_model().bodies
    z = torch.randn(5, *bodies.z.shape, generator=torch.Generator().manual_seed(0)).double()
    inertia = bodies.value_of(z)
    torch.testing.assert_close(bodies.parameters_of(inertia), z)


def test_samples_of_a_run_are_files_with_a_table(fitted, tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="the mujoco extra is not installed")
    model, covariance, _ = fitted
    config = {"dataset": {}, "model_name": "known"}
    run = Run(tmp_path, config, model, statistics(2), {}, {}, covariance=covariance)
    table = pd.read_csv(run.export(tmp_path / "arm.xml", samples=3, seed=5))
    assert list(table.file) == ["arm_00.xml", "arm_01.xml", "arm_02.xml"]
    draws = run.sample(3, seed=5)
    q = np.array([0.3, -0.8])
    for file, mass, draw in zip(table.file, table["mass of lower [kg]"], draws, strict=True):
        robot = mujoco.MjModel.from_xml_path(str(tmp_path / file))
        assert robot.body_mass[-1] == pytest.approx(mass)
        data, matrix = mujoco.MjData(robot), np.empty((2, 2))
        data.qpos[:] = q
        mujoco.mj_forward(robot, data)
        mujoco.mj_fullM(robot, data, matrix)
        np.testing.assert_allclose(matrix, draw.mass_matrix(torch.from_numpy(q)), rtol=1e-6)
    assert table["mass of lower [kg]"].nunique() == 3
    with pytest.raises(ValueError, match=r"samples are .urdf or .xml files"):
        run.export(tmp_path / "arm.c", samples=2)
    with pytest.raises(TypeError, match="no posterior"):
        Run(tmp_path, config, model, statistics(2), {}, {}).sample(2)
