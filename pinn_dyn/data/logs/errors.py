"""The one error of the logs."""


class LogError(ValueError):
    """A log or its description cannot be used; the message names the place and what to do."""
