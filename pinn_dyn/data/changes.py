"""What changed between two fingerprints of a data set, in words."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


def fingerprint_changes(recorded: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """What is different now, a sentence each; empty if nothing is.

    Args:
        recorded: what :meth:`DataSource.fingerprint` gave then, also read back from JSON.
        now: what it gives now.
    """
    before, after = (json.loads(json.dumps(one)) for one in (recorded, now))
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
        elif key == "class" and _same_name(before[key], after[key]):
            changes.append(f"the code of {name.removesuffix('.class')} was edited")
        else:
            changes += _settings(name, before[key], after[key])
    return changes


def _same_name(before: Any, after: Any) -> bool:
    return before != after and str(before).split()[0] == str(after).split()[0]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
