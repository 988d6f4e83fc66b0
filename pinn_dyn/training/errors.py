"""Errors of a training."""


class NonFiniteLossError(RuntimeError):
    """Error: the training loss became NaN or infinite."""
