"""Coupled oscillators in latent coordinates: equations, and bounded rollouts."""

import math

import numpy as np
import pytest
import scipy
import torch

from pinn_dyn.mechanics import Signal
from pinn_dyn.models import CoupledOscillators
from pinn_dyn.testing import assert_near
from tests.models.builders import STEP, make_statistics
from tests.models.test_subspace_encoder import faded, network

N = 4


def oscillators(seed=0, spread=0.3, **options):
    torch.manual_seed(seed)
    sizes = {"oscillators": N, "hidden": [8], "force_hidden": [8]}
    model = CoupledOscillators(make_statistics(2, 2), **sizes, **options)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(spread * torch.randn_like(parameter))
    return model.double().requires_grad_(False)


def factors(model):
    """K, D, W and b in NumPy."""
    L_K, L_D = (
        np.tril(x.numpy(), -1) + np.diag(np.exp(np.diag(x.numpy())))
        for x in (model.stiffness, model.damping)
    )
    return L_K @ L_K.T, L_D @ L_D.T, model.coupling.numpy(), model.bias.numpy()


def test_a_step_solves_the_equation_of_motion_at_the_mean_state():
    """The implicit equation of a step, solved by SciPy."""
    model = oscillators()
    K, D, W, b = factors(model)
    x0, u = torch.randn(4).double(), torch.randn(6, 2).double()
    s = make_statistics(2, 2)
    ends = (u.numpy() - s.u_mean.numpy()) / s.u_std.numpy()
    mean, std = model.mean.numpy(), model.std.numpy()
    x = network(model.encoder, (np.concatenate([x0.numpy(), u[0].numpy()]) - mean) / std)
    y = [network(model.output, x)]
    for k in range(5):
        mean_and_change = [(ends[k] + ends[k + 1]) / 2, ends[k + 1] - ends[k]]
        force = network(model.force, np.concatenate(mean_and_change))
        z, v = np.split(x, 2)

        def residual(later, z=z, v=v, force=force):
            z_next, v_next = np.split(later, 2)
            coupling = W.T @ (np.tanh(W @ z + b) + W @ (z_next - z) / 2)
            acceleration = force - K @ (z + z_next) / 2 - D @ (v + v_next) / 2 - coupling
            return np.concatenate([z_next - z - (v + v_next) / 2, v_next - v - acceleration])

        x = scipy.optimize.root(residual, x, tol=1e-13).x
        y.append(network(model.output, x))
    start = (x0.numpy() - mean[:4]) / std[:4]
    path = [start, *faded(model, start, y)]
    t = STEP * torch.arange(6).double()
    found = model.predict(x0, t, Signal(t, u))
    assert_near(found, torch.from_numpy(mean[:4] + std[:4] * np.array(path)), 1e-7)


@pytest.mark.parametrize("spread", [0.3, 2.0])
def test_energy_never_rises_under_a_constant_input(spread):
    """The energy with the potential of the constant force, from far starts, at any parameters."""
    for seed in range(10):
        model = oscillators(seed, spread)
        K, _, W, b = (torch.from_numpy(x) for x in factors(model))
        far = 10 ** (seed % 4) * torch.randn(3, 2 * N, generator=torch.manual_seed(seed)).double()
        path = torch.stack(model.latent_path(far, torch.ones(300, 3, 4).double()))
        z, v = path.split(N, dim=-1)
        x = z @ W.T + b
        log_cosh = x.abs() + torch.log1p(torch.exp(-2 * x.abs())) - math.log(2)
        force = model.step_force(torch.ones(4).double())
        energy = (z @ K * z).sum(-1) / 2 + log_cosh.sum(-1) + v.square().sum(-1) / 2 - z @ force
        assert energy.diff(dim=0).max() <= 1e-9 * energy.abs().max()
        assert (energy[-1] < energy[0]).all()


@pytest.mark.parametrize("spread", [0.3, 2.0])
def test_rollouts_are_bounded_for_any_parameters(spread):
    """The energy of the linear part never rises; bounded inputs keep all starts bounded."""
    for seed in range(10):
        model = oscillators(seed, spread)
        K, _ = model.matrices()
        A, B = model.flow()
        energy = torch.block_diag(K, torch.eye(N)).double()
        root = torch.linalg.cholesky(energy).T
        back = torch.linalg.inv(root)
        norm = torch.linalg.matrix_norm(root @ A @ back, 2)
        assert norm <= 1 + 1e-9
        power = torch.linalg.matrix_power(root @ A @ back, 2**20)
        assert power.abs().max() < 1  # it vanishes
        u = 5 * torch.randn(3, 2001, 4, generator=torch.manual_seed(seed)).double()
        ends = u[:, :-1].movedim(0, 1)
        far = 1e3 * torch.randn(3, 2 * N, generator=torch.manual_seed(seed)).double()
        force = model.step_force(ends).norm(dim=-1).max()
        largest = force + torch.linalg.matrix_norm(model.coupling, 2) * N**0.5
        step = torch.linalg.matrix_norm(root @ B, 2) * largest
        path = torch.stack(model.latent_path(far, ends)) @ root.T
        growth = path.norm(dim=-1).diff(dim=0).max()
        assert growth <= step * (1 + 1e-9)


@pytest.mark.parametrize("spread", [0.1, 1.0])
def test_modes_are_those_of_a_difference_quotient_of_a_step(spread):
    """Eigenvalues and vectors by NumPy, at the state where a long rollout comes to rest."""
    model = oscillators(3, spread)
    u = torch.tensor([0.3, -0.2]).double()
    memory = torch.zeros(model.memory_size).double()
    for _ in range(3000):
        memory, *_ = model.next_state(memory, u, u)
    rest = memory[: 2 * N]
    assert_near(model.equilibrium(model.latent_force(u)), rest[:N], 1e-7)

    def step(x):
        later, q, _ = model.next_state(torch.cat([x, torch.zeros(16).double()]), u, u)
        return later[: 2 * N].numpy(), q.numpy()

    size = 1e-5
    sides = [[step(rest + s * size * e) for e in torch.eye(2 * N).double()] for s in (1, -1)]
    A, C = (
        np.stack([(a[k] - b[k]) / (2 * size) for a, b in zip(*sides, strict=True)], axis=-1)
        for k in (0, 1)
    )
    values, vectors = np.linalg.eig(A)
    kept = values.imag >= -1e-12
    poles = np.log(values[kept].astype(complex)) / STEP
    modes = model.modes(u)
    assert modes.share[0] == 1
    assert (modes.share.diff() <= 0).all()
    for k, pole in enumerate(poles):
        distance = np.abs(modes.frequency.numpy() - abs(pole) / (2 * np.pi))
        index = int(distance.argmin())
        assert distance[index] < 1e-4 * abs(pole)
        assert abs(modes.damping[index] + pole.real / abs(pole)) < 1e-4
        # q after the step is C times the vector, times the eigenvalue.
        shape, expected = modes.shapes[index].numpy(), C @ vectors[:, kept][:, k]
        cosine = abs(np.vdot(shape, expected)) / np.linalg.norm(shape) / np.linalg.norm(expected)
        assert cosine > 1 - 1e-6
    assert len(modes.to_frame(["a [m]", "b [m]"])) == len(poles)
