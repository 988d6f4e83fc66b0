"""Coupled oscillators in latent coordinates: equations, and bounded rollouts."""

import numpy as np
import pytest
import scipy
import torch

from pinn_dyn.mechanics import Signal
from pinn_dyn.models import CoupledOscillators
from pinn_dyn.testing import assert_near
from tests.models.builders import STEP, make_statistics
from tests.models.test_subspace_encoder import network

N = 4


def oscillators(seed=0, spread=0.3):
    torch.manual_seed(seed)
    model = CoupledOscillators(make_statistics(2, 2), oscillators=N, hidden=[8], force_hidden=[8])
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(spread * torch.randn_like(parameter))
    return model.double().requires_grad_(False)


def test_a_step_is_that_of_the_held_force():
    """The exact flow of the linear part by SciPy, with a force that is constant in the step."""
    model = oscillators()
    L_K, L_D = (
        np.tril(x.numpy(), -1) + np.diag(np.exp(np.diag(x.numpy())))
        for x in (model.stiffness, model.damping)
    )
    K, D, W, b = L_K @ L_K.T, L_D @ L_D.T, model.coupling.numpy(), model.bias.numpy()
    x0, u = torch.randn(4).double(), torch.randn(6, 2).double()
    s = make_statistics(2, 2)
    ends = (u.numpy() - s.u_mean.numpy()) / s.u_std.numpy()
    mean, std = model.mean.numpy(), model.std.numpy()
    x = network(model.encoder, (np.concatenate([x0.numpy(), u[0].numpy()]) - mean) / std)
    y = [network(model.output, x)]
    for k in range(5):
        force = (network(model.force, ends[k]) + network(model.force, ends[k + 1])) / 2
        force = force - W.T @ np.tanh(W @ x[:N] + b)

        def rate(_, x, force=force):
            return [*x[N:], *(force - K @ x[:N] - D @ x[N:])]

        x = scipy.integrate.solve_ivp(rate, (0, 1), x, rtol=1e-10, atol=1e-12).y[:, -1]
        y.append(network(model.output, x))
    fade = 1 / (1 + np.exp(-model.fade.numpy()))
    start = (x0.numpy() - mean[:4]) / std[:4]
    path = [y[k] + fade**k * (start - y[0]) for k in range(6)]
    t = STEP * torch.arange(6).double()
    found = model.predict(x0, t, Signal(t, u))
    assert_near(found, torch.from_numpy(mean[:4] + std[:4] * np.array(path)), 1e-7)


@pytest.mark.parametrize("spread", [0.3, 2.0])
def test_rollouts_are_bounded_for_any_parameters(spread):
    """The energy of the linear part never rises; bounded inputs keep all starts bounded."""
    for seed in range(10):
        model = oscillators(seed, spread)
        K, _ = model.matrices()
        E, G = model.flow()
        energy = torch.block_diag(K, torch.eye(N)).double()
        root = torch.linalg.cholesky(energy).T
        back = torch.linalg.inv(root)
        norm = torch.linalg.matrix_norm(root @ E @ back, 2)
        assert norm <= 1 + 1e-9
        power = torch.linalg.matrix_power(root @ E @ back, 2**20)
        assert power.abs().max() < 1  # it vanishes
        u = 5 * torch.randn(3, 2001, 4, generator=torch.manual_seed(seed)).double()
        ends = u[:, :-1].movedim(0, 1)
        far = 1e3 * torch.randn(3, 2 * N, generator=torch.manual_seed(seed)).double()
        start, end = ends.chunk(2, dim=-1)
        force = (model.force(start) + model.force(end)).norm(dim=-1).max() / 2
        largest = force + torch.linalg.matrix_norm(model.coupling, 2) * N**0.5
        step = torch.linalg.matrix_norm(root @ G, 2) * largest
        path = torch.stack(model.latent_path(far, ends)) @ root.T
        growth = path.norm(dim=-1).diff(dim=0).max()
        assert growth <= step * (1 + 1e-9)
