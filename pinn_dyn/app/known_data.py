"""Whether data and known mechanics speak of the same joints, and of forces."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from typing import Any, Literal

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.parts import build_part
from pinn_dyn.data import DataSource, LogSource
from pinn_dyn.models.known import Structure

log = logging.getLogger(__name__)

_KNOWN = "pinn_dyn.models.KnownMechanics"
_FORCES = ("Nm", "N")
_SHORTEST = 3
"""Letters of a joint's name without the word joint: of fewer any column may have them."""


def check_known(config: dict[str, Any], source: DataSource) -> None:
    """Refuse known mechanics whose joints are not the data's, or whose inputs are no forces.

    Where the columns do not name the joints, their order counts: it is logged.

    Raises:
        ConfigError: if there are more or fewer columns than joints, their names or units show
            another order, or inputs such as currents have no drive gains.
    """
    model = config["model"]
    for place, part in (("model", model), ("model.known", model.get("known"))):
        if isinstance(part, dict) and part.get("_target_") == _KNOWN:
            structure = build_part(f"{place}.structure", part["structure"])
            if isinstance(structure, Structure):
                check_structure(f"{place}.structure", part["structure"], structure, source)
                _check_gains(place, part, structure.num_coordinates, source)


def check_structure(
    place: str, part: dict[str, Any], structure: Structure, source: DataSource
) -> None:
    """Refuse a structure whose joints are not the data's.

    Args:
        place: where it stands in the configuration.
        part: what stands there.
        structure: what was built of it.
        source: the data.

    Raises:
        ConfigError: if there are more or fewer columns than joints, or their names or units show
            another order.
    """
    _check_joints(place, structure.joint_names, list(part.get("locked_joints", ())), source)
    _check_units(place, structure, source)


def _signals(source: DataSource) -> Iterator[tuple[str, list[str]]]:
    """Where the columns of q, v and u are chosen, and their names."""
    if not isinstance(source, LogSource):
        yield "dataset.labels", list(source.labels)
        yield "dataset.input_labels", list(source.input_labels)
        return
    for name, signal in (("q", source.q), ("v", source.v), ("u", source.u)):
        if signal is not None:
            yield f"dataset.{name}.columns", signal.columns


def _check_joints(place: str, joints: list[str], locked: list[str], source: DataSource) -> None:
    both = f"{place} has the joints {', '.join(joints)}"
    unnamed = []
    for where, columns in _signals(source):
        found = _joints_of(columns, joints)
        if len(columns) != len(joints):
            raise ConfigError(
                f"{where} has {len(columns)} entries, {', '.join(columns)}, and {both}: expected "
                f"one for each joint. {_how_to_agree(place, columns, joints, locked, found)}"
            )
        if any(joint not in (None, k) for k, joint in enumerate(found)):
            right = [columns[found.index(k)] if k in found else "?" for k in range(len(joints))]
            raise ConfigError(
                f"{where} is in the order {', '.join(columns)}, and {both}: expected the order of "
                f"the URDF in q, v and u, here {where}=[{','.join(right)}]"
            )
        if None in found:
            unnamed.append(columns)
    if unnamed:
        pairs = zip(map(", ".join, zip(*unnamed, strict=True)), joints, strict=True)
        log.info("column -> joint, by their order: %s", "; ".join(map(" -> ".join, pairs)))


def _how_to_agree(
    place: str,
    columns: list[str],
    joints: list[str],
    locked: list[str],
    found: list[int | None],
) -> str:
    """What to do about columns and joints of which one side has more."""
    without = [name for k, name in enumerate(joints) if k not in found]
    unnamed = [name for name, joint in zip(columns, found, strict=True) if joint is None]
    if len(columns) > len(joints):
        some = 0 < len(unnamed) < len(columns)
        named = f", {', '.join(unnamed)} by their names" if some else ""
        return f"Leave out the columns that are no joints{named}, or give this robot's URDF"
    if len(columns) == len(joints) - len(without):
        return f"No column names the others: lock them, {place}.locked_joints=" + (
            f"[{','.join([*locked, *without])}]"
        )
    return f"Lock the others: {place}.locked_joints=[...]"


def _joints_of(columns: Sequence[str], joints: Sequence[str]) -> list[int | None]:
    """The joint that each column names; None where it names none, or two of them name one."""
    found = [_joint_of(_plain(column), joints) for column in columns]
    return [None if found.count(joint) > 1 else joint for joint in found]


def _joint_of(column: str, joints: Sequence[str]) -> int | None:
    """The joint with the longest name in a column's, as joint10 has joint1 in it too."""
    lengths = []
    for name in map(_plain, joints):
        short = name.replace("joint", "")
        names = [name, short] if len(short) >= _SHORTEST else [name]
        lengths.append(max((len(one) for one in names if one in column), default=0))
    longest = max(lengths)
    return lengths.index(longest) if longest and lengths.count(longest) == 1 else None


def _plain(name: str) -> str:
    """Letters and digits alone, as shoulder_pan, shoulder.pan and ShoulderPan are one."""
    return re.sub(r"[\W_]", "", name.split(" [")[0].lower())


def _check_units(place: str, structure: Structure, source: DataSource) -> None:
    """Refuse a joint that turns by metres, or slides by radians."""
    for (name, unit), joint, turns in zip(
        _units(source, "q"), structure.joint_names, structure.turning, strict=True
    ):
        expected = "rad" if turns else "m"
        if unit not in (None, expected):
            raise ConfigError(
                f"{name} is in {unit}, and joint {joint} of {place} "
                f"{'turns' if turns else 'slides'}: expected {expected}; is it the column "
                "of another joint, or the unit wrong (dataset.q.unit)?"
            )


def _check_gains(place: str, part: dict[str, Any], size: int, source: DataSource) -> None:
    if part.get("gain_spread", 0) != 0:
        return
    gain = part.get("drive_gain", 1)
    gains = gain if isinstance(gain, list) else [gain] * size
    other = [
        f"{name} in {unit}"
        for (name, unit), own in zip(_units(source, "u"), gains, strict=False)
        if unit not in (None, *_FORCES) and own == 1
    ]
    if other:
        raise ConfigError(
            f"the inputs are {', '.join(other)}, and {place}.drive_gain is {gain} with "
            f"{place}.gain_spread=0, which takes them for Nm: expected drive gains, as "
            f"{place}.drive_gain=10 {place}.gain_spread=0.5 (Nm or N per unit, known within some "
            "50 %), or the unit of a force (dataset.u.unit) if the columns hold forces"
        )


def _units(source: DataSource, signal: Literal["q", "u"]) -> Iterator[tuple[str, str | None]]:
    """Names and units of the coordinates or the inputs; None where nobody said the unit."""
    if isinstance(source, LogSource):
        given = source.q if signal == "q" else source.u
        for name, unit, in_file in zip(given.columns, given.units, given.file_units, strict=True):
            yield name, None if in_file == "1" else in_file if unit == "1" else unit
        return
    for label in source.labels if signal == "q" else source.input_labels:
        name, _, unit = label.rstrip("]").partition(" [")
        yield name, unit or None
