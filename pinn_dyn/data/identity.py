"""Identity of a data set: hashes and moments of its trajectories, and what changed in them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pinn_dyn.data.source import SPLITS, DataSource
from pinn_dyn.mechanics import Trajectory

# Samples of each trajectory at which p = M(q) v is compared: it follows from q and v.
_MOMENTA = 8
# Largest difference of moments that rounding explains, in standard deviations.
_ROUNDING = 1e-6


def data_identity(source: DataSource) -> dict[str, dict[str, Any]]:
    """Return what identifies the data of a source, for a checkpoint.

    Each split has the ``names``, ``lengths`` and ``hashes`` of its K trajectories, their
    ``moments`` ``(K, 2, 2N + M)``, mean and standard deviation of q, v and u, and their
    ``momenta`` ``(K, 2, N)``, those of p, empty where p is unknown.
    """
    splits, names = source.load(), source.names()
    return {split: _identity(names[split], getattr(splits, split)) for split in SPLITS}


def _identity(names: list[str], trajectories: list[Trajectory]) -> dict[str, Any]:
    return {
        "names": list(names),
        "lengths": [len(item.t) for item in trajectories],
        "hashes": [_hash(item) for item in trajectories],
        "moments": _stacked([_moments(_signals(item)) for item in trajectories]),
        "momenta": _stacked([_moments(_momenta(item)) for item in trajectories if item.momentum]),
    }


def _signals(item: Trajectory) -> Tensor:
    return torch.cat([item.q, item.v, item.u], dim=-1).double()


def _momenta(item: Trajectory) -> Tensor:
    samples = slice(None, None, max(len(item.t) // _MOMENTA, 1))
    return item.states("qp", samples)[:, item.q.shape[-1] :].double()


def _moments(x: Tensor) -> Tensor:
    return torch.stack([x.mean(0), x.std(0, correction=0)])


def _stacked(values: list[Tensor]) -> Tensor:
    return torch.stack(values) if values else torch.zeros(0)


def _hash(item: Trajectory) -> str:
    content = hashlib.sha256()
    for value in (item.t, item.q, item.v, item.u):
        content.update(f"{tuple(value.shape)}".encode() + value.contiguous().numpy().tobytes())
    return content.hexdigest()[:16]


def data_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """List the differences between two identities, a sentence each.

    Data that differ by rounding alone, as those of another machine do, are the same.
    """
    earlier, present = _by_name(before), _by_name(now)
    changes = [f"{name} is no longer in {earlier[name].split}" for name in earlier.keys() - present]
    changes += [f"{name} is new in {present[name].split}" for name in present.keys() - earlier]
    for name in earlier.keys() & present:
        changes += _difference(name, earlier[name], present[name])
    return sorted(changes)


class _Entry(NamedTuple):
    split: str
    length: int
    content: str
    moments: Tensor
    momenta: Tensor


def _by_name(identity: Mapping[str, Any]) -> dict[str, _Entry]:
    entries: dict[str, _Entry] = {}
    for split, part in identity.items():
        for k, name in enumerate(part["names"]):
            momenta = part["momenta"][k] if len(part["momenta"]) else part["momenta"]
            unique = name if name not in entries else f"{name}, in {split}"
            entries[unique] = _Entry(
                split, part["lengths"][k], part["hashes"][k], part["moments"][k], momenta
            )
    return entries


def _difference(name: str, before: _Entry, now: _Entry) -> list[str]:
    if before.split != now.split:
        return [f"{name} moved from {before.split} to {now.split}"]
    if before.length != now.length:
        return [f"{name} in {now.split} has {now.length} samples, it had {before.length}"]
    if before.content != now.content and not _equal(before.moments, now.moments):
        return [f"{name} in {now.split} has other values"]
    if len(before.momenta) and len(now.momenta) and not _equal(before.momenta, now.momenta):
        return [f"{name} in {now.split} has other momenta p"]
    return []


def _equal(before: Tensor, now: Tensor) -> bool:
    """Check whether moments ``(2, C)`` agree up to rounding."""
    if before.shape != now.shape:
        return False
    return bool(((before - now).abs() <= _ROUNDING * now[1] + 1e-12).all())
