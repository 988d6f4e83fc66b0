"""What every controller must satisfy, with or without a model, guarded or not.

Inherit :class:`ControllerContract` in a test class and override the ``controller`` fixture.
"""

import pytest
import torch

from pinn_dyn.control import Controller, Motion
from tests.support.finite_differences import assert_near


def states(n, batch=6, seed=5):
    """q, v and a desired motion, uniform in [-0.8, 0.8], ``(batch, N)`` each, float64."""
    generator = torch.Generator().manual_seed(seed)
    q, v, *motion = (
        1.6 * torch.rand(batch, n, generator=generator, dtype=torch.float64) - 0.8 for _ in range(5)
    )
    return q, v, Motion(*motion)


def row(motion, k):
    return Motion(*(x[k] for x in motion))


class ControllerContract:
    @pytest.fixture
    def controller(self) -> Controller:
        """The implementation, its model in float64."""
        raise NotImplementedError("override the fixture 'controller'")

    @pytest.fixture
    def at(self, controller):
        """Where to test; override if the controller lives in another range."""
        return states(controller.num_coordinates)

    def test_one_state_and_a_batch_give_the_same_input(self, controller, at):
        q, v, motion = at
        u = controller(0.1, q, v, motion)
        assert u.shape == (len(q), controller.num_inputs)
        assert u.dtype == torch.float64
        for k in (0, len(q) - 1):
            alone = controller(0.1, q[k], v[k], row(motion, k))
            assert alone.shape == (controller.num_inputs,)
            assert_near(alone, u[k], 1e-12)

    @pytest.mark.parametrize("batch", [1, 6])
    def test_one_reference_serves_the_batch(self, controller, at, batch):
        q, v, motion = at[0][:batch], at[1][:batch], row(at[2], 3)
        repeated = Motion(*(x.expand_as(q) for x in motion))
        u = controller(0.1, q, v, motion)
        assert u.shape == (batch, controller.num_inputs)
        assert_near(u, controller(0.1, q, v, repeated), 1e-12)

    def test_the_same_run_again_gives_the_same_inputs(self, controller, at):
        q, v, motion = at
        q_before = q.clone()
        runs = []
        for _ in range(2):
            controller.reset()
            runs.append([controller(0.1 * k, (1 - 0.1 * k) * q, v, motion) for k in range(3)])
        assert torch.equal(q, q_before)
        for first, second in zip(*runs, strict=True):
            assert torch.equal(first, second)

    def test_no_graph_is_kept(self, controller, at):
        q, v, motion = at
        u = controller(0.1, q.clone().requires_grad_(True), v, motion)
        assert not u.requires_grad
        for value in (*controller.diagnostics().values(), *controller.faults().values()):
            assert not value.requires_grad

    def test_diagnostics_and_faults_have_one_entry_per_state(self, controller, at):
        q, v, motion = at
        controller(0.1, q, v, motion)
        controller.reset()
        assert controller.diagnostics() == {}
        assert controller.faults() == {}
        for index, batch in ((slice(None), (len(q),)), (0, ())):
            controller(0.1, q[index], v[index], row(motion, index))
            for name, value in controller.diagnostics().items():
                assert value.shape == batch, name
                assert value.dtype == torch.float64, name
            for reason, mask in controller.faults().items():
                assert mask.shape == batch, reason
                assert mask.dtype == torch.bool, reason

    def test_a_state_that_is_nan_leaves_the_others_alone(self, controller, at):
        q, v, motion = at
        expected = controller(0.1, q, v, motion)
        q, v = q.clone(), v.clone()
        q[2], v[2] = torch.nan, torch.nan
        u = controller(0.1, q, v, motion)
        others = [k for k in range(len(q)) if k != 2]
        assert_near(u[others], expected[others], 1e-12)
        assert not torch.isfinite(u[2]).any()
        for reason, mask in controller.faults().items():
            assert not mask[others].any(), reason

    @pytest.mark.parametrize("wrong", ["q", "v", "reference.q", "reference.v", "reference.a"])
    def test_a_wrong_size_names_the_argument(self, controller, at, wrong):
        q, v, motion = at
        values = {"q": q, "v": v, **{f"reference.{k}": x for k, x in motion._asdict().items()}}
        values[wrong] = torch.cat([values[wrong], q[:, :1]], dim=-1)
        q, v, *motion = values.values()
        with pytest.raises(ValueError, match=f"^{wrong} has shape .* expected"):
            controller(0.1, q, v, Motion(*motion))
