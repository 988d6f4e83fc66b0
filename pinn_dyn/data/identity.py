"""Identity of a data set: hashes and moments of its trajectories, and a list of changes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import torch

from pinn_dyn.data.source import SPLITS, DataSource
from pinn_dyn.mechanics import Trajectory

# Largest difference of moments that rounding explains, in standard deviations.
_ROUNDING = 1e-6


def data_identity(source: DataSource) -> dict[str, dict[str, Any]]:
    """Return ``names``, ``lengths``, ``hashes`` and ``moments`` of the trajectories of each split.

    The moments ``(K, 2, 2N + M + 1)`` are the mean and standard deviation of q, v, u and t.
    """
    splits, names = source.load(), source.names()
    identity = {}
    for split in SPLITS:
        trajectories: list[Trajectory] = getattr(splits, split)
        signals = [torch.cat([x.q, x.v, x.u, x.t[:, None]], dim=-1).double() for x in trajectories]
        moments = [torch.stack([x.mean(0), x.std(0, correction=0)]) for x in signals]
        identity[split] = {
            "names": list(names[split]),
            "lengths": [len(x) for x in signals],
            "hashes": [_hash(x) for x in trajectories],
            "moments": torch.stack(moments) if moments else torch.zeros(0),
        }
    return identity


def _hash(item: Trajectory) -> str:
    values = (item.t, item.q, item.v, item.u)
    content = b"".join(f"{tuple(x.shape)}".encode() + x.numpy().tobytes() for x in values)
    return hashlib.sha256(content).hexdigest()[:16]


def data_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return a sentence for each difference of two identities beyond rounding."""
    earlier, present = _by_name(before), _by_name(now)
    changes = [f"{name} is no longer in {earlier[name][0]}" for name in earlier.keys() - present]
    changes += [f"{name} is new in {present[name][0]}" for name in present.keys() - earlier]
    for name in earlier.keys() & present:
        old_split, old_length, old_hash, old_moments = earlier[name]
        split, length, content, moments = present[name]
        if split != old_split:
            changes.append(f"{name} moved from {old_split} to {split}")
        elif length != old_length:
            changes.append(f"{name} in {split} has {length} samples, it had {old_length}")
        elif content != old_hash:
            same = ((old_moments - moments).abs() <= _ROUNDING * moments[1] + 1e-12).all()
            changes += [] if same else [f"{name} in {split} has other values"]
    return sorted(changes)


def _by_name(identity: Mapping[str, Any]) -> dict[str, tuple[Any, ...]]:
    entries: dict[str, tuple[Any, ...]] = {}
    for split, part in identity.items():
        columns = (part[key] for key in ("names", "lengths", "hashes", "moments"))
        for name, *values in zip(*columns, strict=True):
            entries[name if name not in entries else f"{name}, in {split}"] = (split, *values)
    return entries
