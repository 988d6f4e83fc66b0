"""SOAP on batches of filled-up matrices moves each as the library's SOAP moves it alone."""

import torch
from pytorch_optimizer import SOAP as Library

from pinn_dyn.training import SOAP

SHAPES = [(5, 5), (3, 7), (6, 2), (1, 4), (40, 3), (2, 33), (6,), ()]
SETTINGS = {"lr": 0.01, "weight_decay": 0.1, "precondition_frequency": 4}


def parameters():
    generator = torch.Generator().manual_seed(0)
    options = dict(generator=generator, dtype=torch.float64)
    return [torch.nn.Parameter(torch.randn(shape, **options)) for shape in SHAPES]


def copies(parameters):
    """The same parameters for another optimizer."""
    return [torch.nn.Parameter(p.detach().clone()) for p in parameters]


def steps(several, alone, optimizers, count, seed):
    """Each takes so many steps along the same gradients."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(count):
        for parameter in several:
            parameter.grad = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
        for parameter, other in zip(several, alone, strict=True):
            other.grad = parameter.grad.clone()
        for optimizer in optimizers:
            optimizer.step()


def take_bases(ours, several, theirs, alone):
    """Give the library our first bases: where a gradient leaves one open, rounding chooses it."""
    for batch in ours._batches[0]:
        bases = ours.state[batch.parameters[0]]["bases"]
        for k, parameter in enumerate(batch.parameters):
            (position,) = [j for j, other in enumerate(several) if other is parameter]
            if bases:
                pairs = zip(bases, parameter.shape, strict=True)
                turned = [basis[k, :size, :size].clone() for basis, size in pairs]
                theirs.state[alone[position]]["Q"] = turned


def test_every_matrix_moves_as_it_does_alone():
    """The bases are turned three times, each time after gradients along every direction."""
    several = parameters()
    alone = copies(several)
    settings = {**SETTINGS, "precondition_frequency": 20}
    ours, theirs = SOAP(several, **settings), Library(alone, **settings)
    steps(several, alone, [ours, theirs], 1, seed=1)
    take_bases(ours, several, theirs, alone)
    start = [p.detach().clone() for p in several]
    steps(several, alone, [ours, theirs], 65, seed=2)
    for found, expected in zip(several, alone, strict=True):
        # The library decomposes in float32.
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
    for before, after in zip(start, several, strict=True):
        assert (after - before).abs().min() > 1e-6  # by chance near zero, as rounding differs


def test_the_zeros_that_fill_a_matrix_up_stay_zeros():
    several = parameters()
    optimizer = SOAP(several, **SETTINGS)
    steps(several, copies(several), [optimizer], 13, seed=1)
    filled = 0
    for batch in optimizer._batches[0]:
        bases = optimizer.state[batch.parameters[0]]["bases"]
        for k, parameter in enumerate(batch.parameters):
            for basis, size in zip(bases, parameter.shape, strict=False):
                assert (basis[k, :size, size:] == 0).all()
                assert (basis[k, size:, :size] == 0).all()
                filled += basis.shape[-1] - size
    assert filled > 100
