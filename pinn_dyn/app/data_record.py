"""What the data of a run were, recorded in its folder and compared afterwards."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.run_folder import write_json
from pinn_dyn.data import DataSource, fingerprint_changes, moments, same_moments

DATA = "data.json"
"""The fingerprint of the data that the run was trained on."""

_MOMENTS = "moments"
"""In it, the moments of the data: what counts where only the code was edited."""

_MOST_CHANGES = 10  # that are shown

log = logging.getLogger(__name__)


def write_data(folder: Path, source: DataSource) -> None:
    """Record what the data of a run are, for :func:`check_data`."""
    record = {**source.fingerprint(), _MOMENTS: moments(source.load())}
    write_json(folder / DATA, record)


def check_data(folder: Path, source: DataSource) -> None:
    """Refuse data that are not those that a run was trained on; warn where the run does not say.

    An added or edited file moves runs between training, validation and test, so that a test motion
    may be one that the training saw.

    Raises:
        ConfigError: with what has changed since.
    """
    path = folder / DATA
    if not path.is_file():
        log.warning(
            "%s has no %s, as an earlier version trained it: nobody knows whether %s has changed "
            "since",
            *(folder, DATA, source.name),
        )
        return
    now = source.fingerprint()
    try:
        recorded = json.loads(path.read_text())
        seen = recorded.pop(_MOMENTS, None)
        changes = fingerprint_changes(recorded, now)
        if changes and seen and not fingerprint_changes(recorded, now, code=False):
            # Another version of the code that makes the same data of the same files and settings.
            changes = [] if same_moments(seen, moments(source.load())) else changes
    except (ValueError, AttributeError, KeyError, TypeError, RecursionError) as error:
        raise ConfigError(f"{path} cannot be read, it may be damaged: {error}") from error
    if changes:
        shown = changes[:_MOST_CHANGES]
        if len(changes) > len(shown):
            shown.append(f"and {len(changes) - len(shown)} more")
        raise ConfigError(
            f"{source.name} has changed since {folder} was trained:\n  "
            + "\n  ".join(shown)
            + "\nBring the data back as they were, or train again. To use them all the same, "
            f"delete {path}"
        )
