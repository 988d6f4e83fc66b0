"""Derivatives by finite differences, the independent check on every analytic derivative."""

import torch


def slope(function, step=1e-3):
    """df/de at e = 0 by the five-point stencil, with an error of order step^4."""
    near = function(step) - function(-step)
    far = function(2 * step) - function(-2 * step)
    return (8 * near - far) / (12 * step)


def partial_derivatives(function, x, step=1e-3):
    """The slopes of ``function`` along each entry of ``x`` ``(*batch, n)``, stacked last."""
    directions = torch.eye(x.shape[-1], dtype=x.dtype)
    return torch.stack([slope(lambda e, d=d: function(x + e * d), step) for d in directions], -1)


def assert_near(actual, expected, tolerance, scale=None):
    """Compare with an absolute error of ``tolerance`` times ``scale``.

    The scale is the largest entry of ``expected`` if None: an entry that is small by
    cancellation is no more exact than the terms it is made of.
    """
    scale = float(expected.detach().abs().max()) if scale is None else float(scale)
    torch.testing.assert_close(actual, expected, rtol=0, atol=tolerance * scale)
