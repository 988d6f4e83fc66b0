"""The verdict of a check, which later trainings on the same data ask."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pinn_dyn.atomic_files import write_whole
from pinn_dyn.data.logs import LogSource, Measurement
from pinn_dyn.log_check.equation import Regressor


def store(source: LogSource, rigid: Regressor | None, measurements: Sequence[Measurement]) -> None:
    """Keep the texts of what is not ok in the cache."""
    texts = list(dict.fromkeys(x.text for x in measurements if x.verdict != "ok"))
    path = _path(source, rigid)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(texts))


def stored(source: LogSource, rigid: Regressor | None) -> list[str] | None:
    """Return the texts of the last check of the same data and robot; None if there was none."""
    path = _path(source, rigid)
    return json.loads(path.read_text()) if path.exists() else None


def _path(source: LogSource, rigid: Regressor | None) -> Path:
    """Return the file of a log and a robot: the numbers of both, not their names, are its key."""
    key = hashlib.sha256(repr([source.labels, source.input_labels]).encode())
    for part in source.cleaned:
        for item in part.clean:
            for values in (item.t, item.q, item.v, item.u):
                key.update(np.ascontiguousarray(values).tobytes())
    if rigid is not None:
        random = np.random.default_rng(0)
        motion = random.normal(size=(3, 4, len(source.q.columns)))
        key.update(rigid(*motion).round(9).tobytes())
    folder = Path(os.environ.get("PINN_DYN_CACHE", "~/.cache/pinn_dyn")).expanduser()
    return folder / f"check-{key.hexdigest()[:16]}.json"
