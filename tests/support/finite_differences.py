"""Derivatives by finite differences, the independent check on every analytic derivative."""

import torch


def slope(function, step=1e-3):
    """df/de at e = 0 by the five-point stencil, with an error of order step^4."""
    near = function(step) - function(-step)
    far = function(2 * step) - function(-2 * step)
    return (8 * near - far) / (12 * step)


def partial_derivatives(function, x, step=1e-3):
    """The slopes of ``function`` along each entry of ``x`` ``(*batch, n)``, stacked last.

    The n directions are one more batch dimension, in front, of what the function is called with.
    """
    n = x.shape[-1]
    directions = torch.eye(n, dtype=x.dtype).reshape(n, *[1] * (x.dim() - 1), n)
    return slope(lambda e: function(x + e * directions), step).movedim(0, -1)


def assert_near(actual, expected, tolerance, scale=None):
    """Compare with an absolute error of ``tolerance`` times ``scale``.

    The scale is the largest entry of ``expected`` if None: an entry that is small by
    cancellation is no more exact than the terms it is made of.
    """
    scale = float(expected.detach().abs().max()) if scale is None else float(scale)
    torch.testing.assert_close(actual, expected, rtol=0, atol=tolerance * scale)
