"""Suite for losses. Inherit it and override the ``make`` fixture."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from torch.fx.experimental.proxy_tensor import make_fx

from pinn_dyn.data import Windows
from pinn_dyn.mechanics import RK4, Signal
from pinn_dyn.mechanics.integrators import Wrapped
from pinn_dyn.models import LagrangianNetwork, NetworkCholesky, NetworkInput, NetworkPotential

STEP = 0.02


def random_windows(count, seed=0):
    """Return windows of one step of two coordinates, with an input that jumps within the step."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return 0.3 * torch.randn(count, *shape, generator=generator, dtype=torch.float64)

    t = torch.linspace(0, STEP, 3, dtype=torch.float64)
    q, v, p = normal(2), normal(2), normal(2)
    dq, dv, dp = (STEP * normal(1, 2) for _ in range(3))
    input = Signal(t, normal(3, 2))
    return Windows(
        t=t[[0, 2]], q=q, v=v, p=p, dq=dq, dv=dv, dp=dp, input=input, past_q=q[:, None][:, :0]
    )


def small_model(seed=0):
    """Return a small Lagrangian network in float64."""
    torch.manual_seed(seed)
    return LagrangianNetwork(
        random_windows(50).statistics(),
        mass=partial(NetworkCholesky, hidden=[6, 5]),
        potential=partial(NetworkPotential, hidden=[6, 5]),
        damping=partial(NetworkCholesky, hidden=[5]),
        input=partial(NetworkInput, hidden=[5]),
    ).double()


class WindowLossContract:
    """Suite for a loss of a model on a batch of windows."""

    @pytest.fixture
    def make(self):
        """Return a function that builds the loss from ``statistics`` and ``model``."""
        raise NotImplementedError("override the fixture 'make'")

    @pytest.fixture
    def model(self):
        """Return the model that the loss is built for."""
        return small_model()

    @pytest.fixture
    def loss(self, make, model):
        """Return the loss in float64."""
        return make(statistics=random_windows(50).statistics(), model=model).double()

    def test_loss_is_a_mean_over_windows_with_a_gradient(self, loss, model):
        windows = random_windows(6)
        value = loss(model, windows)
        assert value.shape == ()
        assert value > 0
        gradients = torch.autograd.grad(value, list(model.parameters()), allow_unused=True)
        assert max(float(g.abs().max()) for g in gradients if g is not None) > 0
        alone = [loss(model, windows[torch.tensor([k])]) for k in range(6)]
        torch.testing.assert_close(value, torch.stack(alone).mean())

    def test_loss_can_be_traced(self, loss, model):
        model.integrator = Wrapped(RK4())
        windows, different = random_windows(4), random_windows(4, seed=1)

        def function(q, v, dq, dv, u):
            batch = replace(windows, q=q, v=v, dq=dq, dv=dv, input=windows.input.with_samples(u))
            return loss(model, batch)

        rows = [(w.q, w.v, w.dq, w.dv, w.u) for w in (windows, different)]
        traced = make_fx(function)(*rows[0])
        torch.testing.assert_close(traced(*rows[1]), loss(model, different), rtol=1e-10, atol=0)

    def test_loss_has_no_state_and_selects_the_beginning_of_windows(self, loss):
        assert not list(loss.parameters())
        assert not loss.state_dict()
        windows = random_windows(4)
        for progress in (0.0, 0.5, 0.999):
            part = loss.selected(windows, progress)
            assert torch.equal(part.dq, windows.dq[:, : len(part.t) - 1])
            assert len(part.t) >= 2
