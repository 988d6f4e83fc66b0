"""Clients of PyBullet."""

from __future__ import annotations

import functools
import inspect
from types import SimpleNamespace
from typing import Any


def connect() -> Any:
    """Return PyBullet with its functions bound to a new client, without a display."""
    # Not the wheel's own BulletClient: it closes closed clients when Python ends, and prints.
    bullet = import_bullet()
    client = {"physicsClientId": bullet.connect(bullet.DIRECT)}
    bound = {
        name: functools.partial(item, **client) if inspect.isbuiltin(item) else item
        for name, item in vars(bullet).items()
    }
    return SimpleNamespace(**bound)


def import_bullet() -> Any:
    """Import PyBullet, which is an optional extra.

    Raises:
        ImportError: saying what to install.
    """
    try:
        import pybullet
    except ImportError as error:
        raise ImportError(
            "BulletArm needs PyBullet, which is not installed: pip install 'pinn_dyn[panda]' (its "
            "wheels exist for Python 3.10 and 3.11)"
        ) from error
    return pybullet
