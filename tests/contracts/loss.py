"""What every loss must satisfy.

Inherit :class:`WindowLossContract` in a test class and override the ``make`` fixture.
"""

from dataclasses import replace

import pytest
import torch
from torch.fx.experimental.proxy_tensor import make_fx

from pinn_dyn.ensembles import Ensemble
from pinn_dyn.mechanics import RK4
from pinn_dyn.mechanics.compilation import Unrolled
from tests.models.builders import make_model, perturb
from tests.support.windows import for_members, make_windows, one_step


class WindowLossContract:
    @pytest.fixture
    def make(self):
        """Builds the loss from ``statistics`` and ``model``."""
        raise NotImplementedError("override the fixture 'make'")

    @pytest.fixture
    def model(self):
        return make_model("lnn")

    @pytest.fixture
    def loss(self, make, model):
        return make(statistics=one_step(size=2), model=model).double()

    def test_it_is_a_positive_number_with_a_gradient(self, loss, model):
        value = loss(model, make_windows(6, size=2))
        assert value.shape == ()
        assert value > 0
        gradients = torch.autograd.grad(value, list(model.parameters()), allow_unused=True)
        assert max(float(g.abs().max()) for g in gradients if g is not None) > 0

    def test_it_is_the_mean_over_windows(self, loss, model):
        windows = make_windows(6, size=2)
        alone = [loss(model, windows[torch.tensor([k])]) for k in range(6)]
        torch.testing.assert_close(loss(model, windows), torch.stack(alone).mean())

    def test_it_grows_with_the_error(self, loss, model):
        """Windows that move farther and farther from what the model says."""
        windows = make_windows(6, size=2)
        values = [
            float(loss(model, replace(windows, dv=windows.dv + shift)).detach())
            for shift in (1.0, 10.0, 100.0)
        ]
        assert values == sorted(values)
        assert values[2] > 3 * values[1]

    def test_members_of_an_ensemble_have_the_losses_they_have_alone(self, loss):
        members = [perturb(make_model("lnn"), seed=k) for k in range(3)]
        batches = [make_windows(4, size=2, seed=k) for k in range(3)]
        found = loss(Ensemble(members).stack, for_members(batches))
        alone = torch.stack([loss(one, b) for one, b in zip(members, batches, strict=True)])
        torch.testing.assert_close(found, alone, rtol=1e-10, atol=0)
        assert len(set(alone.tolist())) == 3

    def test_it_can_be_traced(self, loss, model):
        """A traced loss is that of other states than those it was traced with."""
        model.integrator = Unrolled(RK4())
        windows, other = make_windows(4, size=2), make_windows(4, size=2, seed=1)

        def of(q, v, dq, dv, u):
            batch = replace(windows, q=q, v=v, dq=dq, dv=dv, input=windows.input.with_samples(u))
            return loss(model, batch)

        given = [(w.q, w.v, w.dq, w.dv, w.u) for w in (windows, other)]
        traced = make_fx(of)(*given[0])
        torch.testing.assert_close(traced(*given[1]), loss(model, other), rtol=1e-10, atol=0)

    def test_what_counts_of_a_window_is_its_beginning(self, loss):
        windows = make_windows(4, size=2)
        for progress in (0.0, 0.5, 0.999):
            part = loss.selected(windows, progress)
            steps = len(part.t) - 1
            assert 1 <= steps <= len(windows.t) - 1
            assert torch.equal(part.dq, windows.dq[:, :steps])

    def test_it_has_nothing_to_learn_or_to_save(self, loss):
        assert not list(loss.parameters())
        assert not loss.state_dict()
