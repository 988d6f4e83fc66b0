"""Suite for controllers, with or without a model. Inherit it and override ``controller``."""

import pytest
import torch

from pinn_dyn.control import Controller, Motion
from pinn_dyn.testing.finite_differences import assert_near


def states(n, batch=6, seed=5):
    """Return q, v and a desired motion, uniform in [-0.8, 0.8], ``(batch, N)`` each, float64."""
    generator = torch.Generator().manual_seed(seed)
    q, v, *motion = (
        1.6 * torch.rand(batch, n, generator=generator, dtype=torch.float64) - 0.8 for _ in range(5)
    )
    return q, v, Motion(*motion)


def row(motion, k):
    """Return a row of a desired motion."""
    return Motion(*(x[k] for x in motion))


class ControllerContract:
    """Suite for a controller u = c(t, q, v, desired motion)."""

    @pytest.fixture
    def controller(self) -> Controller:
        """Return the implementation, with a model in float64."""
        raise NotImplementedError("override the fixture 'controller'")

    @pytest.fixture
    def at(self, controller):
        """Return the states to test at."""
        return states(controller.num_coordinates)

    def test_a_single_state_and_a_batch_give_the_same_input(self, controller, at):
        q, v, motion = at
        u = controller(0.1, q, v, motion)
        assert u.shape == (len(q), controller.num_inputs)
        assert u.dtype == torch.float64
        for k in (0, len(q) - 1):
            assert_near(controller(0.1, q[k], v[k], row(motion, k)), u[k], 1e-12)

        shared = row(motion, 3)
        repeated = Motion(*(x.expand_as(q) for x in shared))
        assert_near(controller(0.1, q, v, shared), controller(0.1, q, v, repeated), 1e-12)

    def test_a_repeated_run_gives_the_same_inputs(self, controller, at):
        q, v, motion = at
        original = q.clone()
        runs = []
        for _ in range(2):
            controller.reset()
            runs.append([controller(0.1 * k, (1 - 0.1 * k) * q, v, motion) for k in range(3)])
        assert torch.equal(q, original)
        for first, second in zip(*runs, strict=True):
            assert torch.equal(first, second)

    def test_diagnostics_and_faults_have_an_entry_for_each_state(self, controller, at):
        q, v, motion = at
        assert not controller(0.1, q.clone().requires_grad_(True), v, motion).requires_grad
        for value in (*controller.diagnostics().values(), *controller.faults().values()):
            assert not value.requires_grad
        controller.reset()
        assert controller.diagnostics() == {}
        assert controller.faults() == {}
        for index, batch in ((slice(None), (len(q),)), (0, ())):
            controller(0.1, q[index], v[index], row(motion, index))
            for name, value in controller.diagnostics().items():
                assert (value.shape, value.dtype) == (batch, torch.float64), name
            for reason, mask in controller.faults().items():
                assert (mask.shape, mask.dtype) == (batch, torch.bool), reason

    def test_a_nan_state_does_not_affect_the_batch(self, controller, at):
        q, v, motion = at
        expected = controller(0.1, q, v, motion)
        q, v = q.clone(), v.clone()
        q[2], v[2] = torch.nan, torch.nan
        u = controller(0.1, q, v, motion)
        finite = [k for k in range(len(q)) if k != 2]
        assert_near(u[finite], expected[finite], 1e-12)
        assert not torch.isfinite(u[2]).any()
        for reason, mask in controller.faults().items():
            assert not mask[finite].any(), reason

    @pytest.mark.parametrize("name", ["q", "v", "reference.q", "reference.v", "reference.a"])
    def test_a_wrong_size_is_refused_by_name(self, controller, at, name):
        q, v, motion = at
        values = {"q": q, "v": v, **{f"reference.{k}": x for k, x in motion._asdict().items()}}
        values[name] = torch.cat([values[name], q[:, :1]], dim=-1)
        q, v, *motion = values.values()
        with pytest.raises(ValueError, match=f"^{name} has shape .* expected"):
            controller(0.1, q, v, Motion(*motion))
