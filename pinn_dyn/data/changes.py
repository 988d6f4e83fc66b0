"""What changed between two fingerprints of a data set, in words."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from pinn_dyn.data.source import SPLITS, Splits

_SIGNALS = ("q", "v", "u")


def moments(splits: Splits) -> dict[str, Any]:
    """Number, mean and standard deviation of the samples of each split, JSON-serializable.

    They tell whether edited code still gives the same data, on a machine that rounds otherwise too.
    """
    found: dict[str, Any] = {}
    for name in SPLITS:
        trajectories = getattr(splits, name)
        found[name] = {"lengths": [len(item.t) for item in trajectories]}
        lengths = torch.tensor(found[name]["lengths"], dtype=torch.float64)
        share = lengths / lengths.sum()
        for key in _SIGNALS if trajectories else ():
            # Trajectory by trajectory: one tensor of all would be a copy of the data.
            each = [torch.var_mean(getattr(x, key).double(), 0, correction=0) for x in trajectories]
            variances, means = map(torch.stack, zip(*each, strict=True))
            mean = share @ means
            std = (share @ (variances + (means - mean).square())).sqrt()
            found[name][key] = {"mean": mean.tolist(), "std": std.tolist()}
    return found


def same_moments(recorded: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Whether two :func:`moments` are of the same data but for rounding: 1e-6 of the spread."""
    for name in SPLITS:
        if recorded[name]["lengths"] != now[name]["lengths"]:
            return False
        for key in _SIGNALS if now[name]["lengths"] else ():
            before, after = recorded[name][key], now[name][key]
            std = np.asarray(after["std"])
            for moment in ("mean", "std"):
                values = np.asarray(before[moment], dtype=float), np.asarray(after[moment])
                if values[0].shape != values[1].shape:
                    return False
                if not (abs(values[0] - values[1]) <= 1e-6 * std + 1e-12).all():
                    return False
    return True


def fingerprint_changes(
    recorded: Mapping[str, Any], now: Mapping[str, Any], *, code: bool = True
) -> list[str]:
    """What is different now, a sentence each; empty if nothing is.

    Args:
        recorded: what :meth:`DataSource.fingerprint` gave then, also read back from JSON.
        now: what it gives now.
        code: whether edited code of a class counts.
    """
    before, after = (json.loads(json.dumps(one)) for one in (recorded, now))
    if not code:
        before, after = _without_code(before), _without_code(after)
    changes = _files(before.pop("files", {}), after.pop("files", {}))
    changes += _runs(before.pop("splits", {}), after.pop("splits", {}))
    return changes + _settings("", before, after)


def _files(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    removed = [f"file {name} is gone" for name in before if name not in after]
    added = [f"file {name} was added" for name in after if name not in before]
    edited = [
        f"file {name} was edited: it had {before[name]['bytes']} bytes, now {after[name]['bytes']}"
        for name in before
        if name in after and before[name] != after[name]
    ]
    return removed + added + edited


def _runs(before: dict[str, list[str]], after: dict[str, list[str]]) -> list[str]:
    """Stretches of runs that came, went or moved between training, validation and test."""
    was, now = (
        {run: split for split, runs in one.items() for run in runs} for one in (before, after)
    )
    moved = [
        f"{run} moved from {was[run]} to {now[run]}"
        for run in was
        if run in now and was[run] != now[run]
    ]
    gone = [f"{run} is no longer in {was[run]}" for run in was if run not in now]
    new = [f"{run} is new in {now[run]}" for run in now if run not in was]
    return moved + gone + new


def _settings(place: str, before: Any, after: Any) -> list[str]:
    if before == after:
        return []
    if not (isinstance(before, dict) and isinstance(after, dict)):
        return [f"{place} was {_short(before)}, now it is {_short(after)}"]
    changes = []
    for key in [*before, *(key for key in after if key not in before)]:
        name = f"{place}.{key}" if place else key
        if key not in after:
            changes.append(f"{name} was {_short(before[key])}, now there is none")
        elif key not in before:
            changes.append(f"{name} is new: {_short(after[key])}")
        elif (
            key == "class" and before[key] != after[key] and _name(before[key]) == _name(after[key])
        ):
            changes.append(f"the code of {name.removesuffix('.class')} was edited")
        else:
            changes += _settings(name, before[key], after[key])
    return changes


def _without_code(value: Any) -> Any:
    """A fingerprint in which a class is its name alone."""
    if isinstance(value, dict):
        return {
            key: _name(item) if key == "class" else _without_code(item)
            for key, item in value.items()
        }
    return [_without_code(item) for item in value] if isinstance(value, list) else value


def _name(text: Any) -> str:
    return str(text).split()[0]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
