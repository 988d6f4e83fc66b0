"""Suite for stages, with or without a model. Inherit it and override ``controller``."""

import pytest
import torch

from pinn_dyn.control import Motion, Pipeline, Stage
from pinn_dyn.control.pipeline import STATUS
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


def input_of(law, q, v, motion, **settings):
    """Return the first input of a law at a measurement, ``(*batch, M)``."""
    pipeline = Pipeline(law, 0.1, **settings)
    return pipeline.call(q, v, motion, q.new_zeros(*q.shape[:-1], pipeline.memory_size)).u


class ControllerContract:
    """Suite for a stage ``step(q, v, reference, applied, memory) -> u, memory``."""

    @pytest.fixture
    def controller(self) -> Stage:
        """Return the implementation, with a model in float64."""
        raise NotImplementedError("override the fixture 'controller'")

    @pytest.fixture
    def pipeline(self, controller):
        """Return the pipeline of the controller."""
        return Pipeline(controller, 0.1)

    @pytest.fixture
    def at(self, controller):
        """Return the states to test at."""
        return states(controller.num_coordinates)

    @staticmethod
    def calls(pipeline, q, v, motion, count=3):
        """Return the results of some calls, each with the memory of the call before."""
        results, memory = [], q.new_zeros(*q.shape[:-1], pipeline.memory_size)
        for k in range(count):
            results.append(pipeline.call((1 - 0.1 * k) * q, v, motion, memory))
            memory = results[-1].memory
        return results

    def test_a_single_state_and_a_batch_give_the_same_inputs(self, controller, pipeline, at):
        q, v, motion = at
        batch = self.calls(pipeline, q, v, motion)
        for result in batch:
            assert result.u.shape == (len(q), controller.num_inputs)
            assert result.u.dtype == torch.float64
        for k in (0, len(q) - 1):
            single = self.calls(pipeline, q[k], v[k], row(motion, k))
            for one, all_states in zip(single, batch, strict=True):
                assert_near(one.u, all_states.u[k], 1e-9)
                assert_near(one.memory, all_states.memory[k], 1e-9)

        shared = row(motion, 3)
        repeated = Motion(*(x.expand_as(q) for x in shared))
        one, other = (self.calls(pipeline, q, v, x)[-1].u for x in (shared, repeated))
        assert_near(one, other, 1e-12)

    def test_a_call_changes_nothing_but_its_result(self, pipeline, at):
        q, v, motion = at
        originals = [x.clone() for x in (q, v, *motion)]
        first, second = (self.calls(pipeline, q, v, motion)[-1] for _ in range(2))
        for value, original in zip((q, v, *motion), originals, strict=True):
            assert torch.equal(value, original)
        assert torch.equal(first.u, second.u)
        assert torch.equal(first.memory, second.memory)

    def test_the_report_has_an_entry_for_each_state(self, controller, at):
        q, v, motion = at
        assert not input_of(controller, q.clone().requires_grad_(True), v, motion).requires_grad
        stage = Pipeline(controller, 0.1).law
        for index, batch in ((slice(None), (len(q),)), (0, ())):
            state = q[index], v[index], row(motion, index)
            applied = q.new_zeros(*batch, controller.num_inputs)
            memory = stage.start(*state[:2], applied)
            if memory is None:
                memory = q.new_zeros(*batch, stage.memory_size)
            with torch.no_grad():
                _, after, *report = stage.step(*state, applied, memory)
            assert after.shape == memory.shape
            for name, value in (report[0] if report else {}).items():
                kind = torch.bool if name in {*STATUS} else torch.float64
                assert (value.shape, value.dtype) == (batch, kind), name

    def test_a_nan_state_does_not_affect_the_batch(self, pipeline, at):
        q, v, motion = at
        expected = self.calls(pipeline, q, v, motion)
        q, v = q.clone(), v.clone()
        q[2], v[2] = torch.nan, torch.nan
        finite = [k for k in range(len(q)) if k != 2]
        for result, other in zip(self.calls(pipeline, q, v, motion), expected, strict=True):
            assert_near(result.u[finite], other.u[finite], 1e-12)
            assert torch.equal(result.status[finite], other.status[finite])
            assert torch.equal(result.u[2], pipeline.first_input)

    @pytest.mark.parametrize("name", ["q", "v", "reference.q", "reference.v", "reference.a"])
    def test_a_wrong_size_is_refused_by_name(self, pipeline, at, name):
        q, v, motion = at
        values = {"q": q, "v": v, **{f"reference.{k}": x for k, x in motion._asdict().items()}}
        values[name] = torch.cat([values[name], q[:, :1]], dim=-1)
        q, v, *motion = values.values()
        memory = q.new_zeros(len(q), pipeline.memory_size)
        with pytest.raises(ValueError, match=f"^{name} has shape .* expected"):
            pipeline.call(q, v, Motion(*motion), memory)
