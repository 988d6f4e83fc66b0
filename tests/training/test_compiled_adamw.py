"""Steps of AdamW within the program of a batch are those of torch."""

import copy
from functools import partial

import pytest
import torch
from torch.optim import Adam, AdamW

from pinn_dyn.mechanics.compilation import STEPS_FOR_PROGRAM, compile_graph
from pinn_dyn.training import MidpointLoss, ParameterVector, one_cycle
from pinn_dyn.training.gradients import Compiled, Eager
from pinn_dyn.training.parameter_vector import CompiledAdamW, clipped
from tests.models.builders import make_model
from tests.support.windows import make_windows, one_step

STEPS = 6


def trained(model, clipping, compiled, state=None, steps=range(STEPS)):
    """The weights and the state of the optimizer after steps of either way."""
    vector = ParameterVector(model.parameters())
    loss = MidpointLoss(one_step(size=2), model).double()
    options = {"lr": 0.05, "betas": (0.8, 0.97), "eps": 1e-6, "weight_decay": 0.1}
    optimizer = AdamW([vector.values], **options, fused=True)
    scheduler = one_cycle(optimizer, total_steps=STEPS, warm_up=0.5)
    if compiled:
        engine = Compiled(loss, model, vector, STEPS_FOR_PROGRAM)
        program = CompiledAdamW(optimizer, vector, *clipping)
    if state is not None:
        optimizer.load_state_dict(state[0])
        scheduler.load_state_dict(state[1])
    for k in steps:
        batch = make_windows(8, size=2, seed=k)
        if compiled:
            engine.step(batch, program)()
        else:
            _, gradient = Eager(loss, model, vector)(batch)
            vector.gradient.copy_(clipped(gradient, *clipping))
            optimizer.step()
        scheduler.step()
    state = copy.deepcopy((optimizer.state_dict(), scheduler.state_dict()))
    return vector.values.detach().clone(), vector.gradient.clone(), state


@pytest.mark.parametrize(
    ("clipping", "built"),
    [
        pytest.param((0.02, True), False, marks=pytest.mark.slow),
        ((0.3, False), False),
        pytest.param((0.3, False), True, marks=pytest.mark.slow),
    ],
)
def test_weights_gradients_and_moments_are_those_of_the_optimizer(request, clipping, built):
    if not built:
        request.getfixturevalue("traced")
    model = make_model("lnn")
    run = partial(trained, clipping=clipping)
    (values, gradient, state), (expected, slope, other) = (
        run(copy.deepcopy(model), compiled=compiled) for compiled in (True, False)
    )
    torch.testing.assert_close(values, expected, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(gradient, slope, rtol=1e-8, atol=1e-12)
    torch.testing.assert_close(state[0]["state"], other[0]["state"], rtol=1e-8, atol=1e-12)
    assert float(state[0]["state"][0]["step"]) == STEPS


def test_optimizers_with_another_formula_are_not_compiled():
    weights = [torch.nn.Parameter(torch.ones(2))]
    assert CompiledAdamW.supports(AdamW(weights, weight_decay=0.1))
    variants = AdamW(weights, amsgrad=True), AdamW(weights, maximize=True), Adam(weights)
    assert not any(map(CompiledAdamW.supports, variants))


def test_a_program_has_equal_constants_once(traced):
    constants = torch.ones(2), torch.ones(2), torch.zeros(2)
    graph = compile_graph(lambda x: [(x * c).tanh() for c in constants], (torch.ones(2),))
    assert len(graph.graph.find_nodes(op="get_attr")) == 2
    assert [y.tolist() for y in graph(torch.ones(2))] == [c.tanh().tolist() for c in constants]
