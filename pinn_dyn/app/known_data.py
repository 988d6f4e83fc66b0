"""Agreement of data and known mechanics: the order and the units of joints, inputs as forces."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from typing import Literal

from pinn_dyn.app.config import ConfigError
from pinn_dyn.data import DataSource, LogSource
from pinn_dyn.mechanics import Predictor
from pinn_dyn.models import KnownAndNetwork, KnownMechanics
from pinn_dyn.models.known import Structure

log = logging.getLogger(__name__)

_FORCES = ("Nm", "N")
_SHORTEST = 3
"""Letters of a joint's name without the word joint; any column may contain shorter names."""


def check_known(model: Predictor, source: DataSource) -> None:
    """Refuse known mechanics whose joints are not the data's, or whose inputs are no forces.

    Raises:
        ConfigError: if names or units of the columns show another order than that of the joints,
            or inputs such as currents have no drive gains.
    """
    mechanics = model.known if isinstance(model, KnownAndNetwork) else model
    if isinstance(mechanics, KnownMechanics):
        check_structure("model.structure", mechanics.structure, source)
        _check_gains(mechanics, source)


def check_structure(path: str, structure: Structure, source: DataSource) -> None:
    """Refuse rigid bodies whose joints are not the data's.

    If the columns do not name the joints, their order counts, and is logged.

    Args:
        path: key of the structure in the configuration.
        structure: rigid bodies.
        source: the data.

    Raises:
        ConfigError: if the number of columns is not that of the joints, or names or units of the
            columns show another order.
    """
    joints = structure.joint_names
    unnamed = []
    for key, columns in _signals(source):
        if len(columns) != len(joints):
            raise ConfigError(
                f"{key} has {len(columns)} columns, {', '.join(columns)}, and {path} has the "
                f"joints {', '.join(joints)}: expected one column for each joint. Lock joints by "
                f"{path}.locked_joints=[...], or leave out columns"
            )
        matches = _joints_of(columns, joints)
        if any(joint not in (None, k) for k, joint in enumerate(matches)):
            order = [columns[matches.index(k)] if k in matches else "?" for k in range(len(joints))]
            raise ConfigError(
                f"{key} has the order {', '.join(columns)}, and {path} has the joints "
                f"{', '.join(joints)}: expected the order of the joints in q, v and u, "
                f"{key}=[{','.join(order)}]"
            )
        if None in matches:
            unnamed.append(columns)
    if unnamed:
        pairs = zip(map(", ".join, zip(*unnamed, strict=True)), joints, strict=True)
        log.info("column -> joint, by their order: %s", "; ".join(map(" -> ".join, pairs)))
    for (name, unit), joint, turns in zip(
        _units(source, "q"), joints, structure.turning, strict=True
    ):
        expected = "rad" if turns else "m"
        if unit not in (None, expected):
            raise ConfigError(
                f"{name} is in {unit}, and joint {joint} of {path} "
                f"{'turns' if turns else 'slides'}: expected {expected}; check the order of the "
                "columns, and dataset.q.unit"
            )


def _signals(source: DataSource) -> Iterator[tuple[str, list[str]]]:
    """Iterate over the keys that choose the columns of q, v and u, with the columns."""
    if not isinstance(source, LogSource):
        yield "dataset.labels", list(source.labels)
        yield "dataset.input_labels", list(source.input_labels)
        return
    for name, signal in (("q", source.q), ("v", source.v), ("u", source.u)):
        if signal is not None:
            yield f"dataset.{name}.columns", signal.columns


def _joints_of(columns: Sequence[str], joints: Sequence[str]) -> list[int | None]:
    """Return the joint that each column names; None if it names none, or two columns name one."""
    matches = [_joint_of(_letters(column), joints) for column in columns]
    return [None if matches.count(joint) > 1 else joint for joint in matches]


def _joint_of(column: str, joints: Sequence[str]) -> int | None:
    """Return the joint with the longest name in that of a column: joint10 contains joint1."""
    lengths = []
    for name in map(_letters, joints):
        short = name.replace("joint", "")
        names = [name, short] if len(short) >= _SHORTEST else [name]
        lengths.append(max((len(text) for text in names if text in column), default=0))
    longest = max(lengths)
    return lengths.index(longest) if longest and lengths.count(longest) == 1 else None


def _letters(name: str) -> str:
    """Return letters and digits: shoulder_pan, shoulder.pan and ShoulderPan are the same name."""
    return re.sub(r"[\W_]", "", name.split(" [")[0].lower())


def _check_gains(model: KnownMechanics, source: DataSource) -> None:
    if model.gain is not None:
        return
    gains = model.fixed_gain.tolist()
    inputs = [
        f"{name} in {unit}"
        for (name, unit), gain in zip(_units(source, "u"), gains, strict=False)
        if unit not in (None, *_FORCES) and gain == 1
    ]
    if inputs:
        raise ConfigError(
            f"the inputs are {', '.join(inputs)}, and model.drive_gain is 1 with "
            "model.gain_spread=0, which means Nm: expected drive gains, as model.drive_gain=10 "
            "model.gain_spread=0.5 (Nm or N per unit, known within 50 %), or the unit of a force "
            "(dataset.u.unit) if the columns hold forces"
        )


def _units(source: DataSource, signal: Literal["q", "u"]) -> Iterator[tuple[str, str | None]]:
    """Iterate over names and units of the coordinates or the inputs; None for an unknown unit."""
    if isinstance(source, LogSource):
        columns = source.q if signal == "q" else source.u
        rows = zip(columns.columns, columns.units, columns.unit, strict=True)
        for name, unit, in_file in rows:
            yield name, None if in_file == "1" else in_file if unit == "1" else unit
        return
    for label in source.labels if signal == "q" else source.input_labels:
        name, _, unit = label.rstrip("]").partition(" [")
        yield name, unit or None
