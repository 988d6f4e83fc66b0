"""Each member of an ensemble moves as the library's SOAP moves a model alone."""

import copy

import pytest
import torch
from pytorch_optimizer import SOAP

from pinn_dyn.ensembles import Ensemble, EnsembleData, EnsembleLearner
from pinn_dyn.ensembles.member_soap import MemberSOAP
from tests.support.ensembles import learn, make_data, make_models, train

MEMBERS = 3
SHAPES = {"square": (5, 5), "wide": (3, 7), "tall": (6, 2), "cube": (3, 4, 2), "vector": (6,)}
SETTINGS = {"lr": 0.01, "weight_decay": 0.1, "precondition_frequency": 4}


def parameters(shape, dtype=torch.float64):
    """Stacked over the members, and those of each member."""
    torch.manual_seed(0)
    value = torch.randn(MEMBERS, *shape, dtype=dtype)
    return torch.nn.Parameter(value), [torch.nn.Parameter(row.clone()) for row in value]


def steps(stacked, single, optimizers, count, seed):
    generator = torch.Generator().manual_seed(seed)
    for _ in range(count):
        gradient = torch.randn(stacked.shape, generator=generator, dtype=stacked.dtype)
        stacked.grad = gradient
        for k, parameter in enumerate(single):
            parameter.grad = gradient[k].clone()
        for optimizer in optimizers:
            optimizer.step()


def take_bases(ours, stacked, theirs, single):
    """Give the library our first bases: where a gradient leaves one open, rounding chooses it."""
    for k, parameter in enumerate(single):
        state = theirs.state[parameter]
        state["Q"] = [q[k].clone() if len(q) else [] for q in ours.state[stacked]["Q"]]


@pytest.mark.parametrize("shape", [*SHAPES.values(), ()], ids=[*SHAPES, "number"])
def test_a_member_moves_as_a_parameter_of_its_own(shape):
    """Thirty steps, in which the bases are turned seven times."""
    stacked, single = parameters(shape)
    ours, theirs = MemberSOAP(SOAP([stacked], **SETTINGS)), SOAP(single, **SETTINGS)
    steps(stacked, single, [ours, theirs], 1, seed=1)
    take_bases(ours, stacked, theirs, single)
    start = stacked.detach().clone()
    steps(stacked, single, [ours, theirs], 30, seed=2)
    assert (stacked - start).abs().min() > 1e-4
    for k, parameter in enumerate(single):
        # Both decompose in float32.
        torch.testing.assert_close(stacked[k], parameter, rtol=1e-5, atol=1e-6)


def test_the_first_bases_diagonalize_the_first_gradient():
    stacked, single = parameters(SHAPES["wide"])
    ours = MemberSOAP(SOAP([stacked], **SETTINGS))
    steps(stacked, single, [ours], 1, seed=1)
    state = ours.state[stacked]
    turned = ours.project(stacked.grad, state)
    for k in range(MEMBERS):
        singular = torch.linalg.svdvals(stacked.grad[k])
        expected = torch.zeros(3, 7, dtype=torch.float64)
        expected[range(3), range(3)] = singular
        torch.testing.assert_close(turned[k].abs(), expected, rtol=0, atol=1e-6)
    back = ours.project(turned, state, project_type="backward")
    torch.testing.assert_close(back, stacked.grad)


def test_a_training_goes_on_from_its_saved_state():
    """The same steps in one go, and with the optimizer written and read half way."""
    (whole, single), (halves, _) = parameters(SHAPES["wide"]), parameters(SHAPES["wide"])
    optimizer = MemberSOAP(SOAP([whole], **SETTINGS))
    steps(whole, single, [optimizer], 6, seed=1)
    steps(whole, single, [optimizer], 6, seed=2)
    first = MemberSOAP(SOAP([halves], **SETTINGS))
    steps(halves, single, [first], 6, seed=1)
    second = MemberSOAP(SOAP([halves], **SETTINGS))
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    steps(halves, single, [second], 6, seed=2)
    assert torch.equal(whole, halves)


@pytest.mark.parametrize("option", ["merge_dims", "precondition_1d", "normalize_gradient"])
def test_what_would_not_be_each_members_own_is_refused(option):
    stacked, _ = parameters(SHAPES["wide"])
    with pytest.raises(ValueError, match=f"optimizer.{option} is true, which an ensemble"):
        MemberSOAP(SOAP([stacked], **{option: True}))


def test_an_ensemble_learns_by_it(tmp_path):
    data = make_data()
    models = make_models("lnn", data, 2)
    ensemble = Ensemble(models)
    losses = []
    learner = learn(EnsembleLearner, ensemble, models[0], data, optimizer=SOAP)
    report = learner.log_losses
    learner.log_losses = lambda values: losses.append(values.clone()) or report(values)
    trainer = train(tmp_path, learner, EnsembleData(data, 2))
    assert [type(optimizer) for optimizer in trainer.optimizers] == [MemberSOAP]
    assert (losses[-1] < 0.5 * losses[0]).all()
