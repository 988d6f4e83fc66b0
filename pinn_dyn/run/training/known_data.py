"""Agreement of data and known mechanics: order and units of the joints, inputs as forces."""

from __future__ import annotations

import inspect
import logging
import math
import re
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch

from pinn_dyn import wording
from pinn_dyn.data import DataSource, LogSource
from pinn_dyn.log_check.check import verdict
from pinn_dyn.log_check.input_faults import SATURATES
from pinn_dyn.mechanics import Predictor, double_copy
from pinn_dyn.models import KnownMechanics
from pinn_dyn.run.configuration.build import ConfigError, ModelBuilder, naming
from pinn_dyn.systems import RigidChain

log = logging.getLogger(__name__)


def match_model(model: Any, source: DataSource) -> tuple[ModelBuilder, dict[str, Any]]:
    """Return the builder of a model whose joints are the columns of the data, and its new settings.

    Of known mechanics, ``structure.joints`` and ``driven_joints`` become the joints that the
    columns name. Of networks without ``angles``, these become the coordinates that turn, see
    :func:`turning`.

    Raises:
        ConfigError: as :func:`match_structure`.
    """
    settings = getattr(model, "keywords", {})
    if "known" in settings:
        mechanics, inner = match_model(settings["known"], source)
        return partial(model, known=mechanics), {"known": inner}
    structure, driven = settings.get("structure"), settings.get("driven_joints")
    if not isinstance(structure, RigidChain):
        return _with_angles(model, source)
    matched = match_structure(structure, source)
    if settings.get("start", "prior") == "prior":
        _log_bodies(matched)
    changes: dict[str, Any] = {"structure": {"joints": matched.joints}}
    names = list(driven or matched.joint_names)
    key, units = _signals(source)[-1]
    columns = list(units)  # targets may have feed-forward forces behind them
    columns = columns[: len(names)] if len(columns) == 2 * len(names) else columns
    inputs = joints_of(columns, names)
    if inputs is None:
        _log_order(key, columns, names)
    elif inputs != names:
        log.info("the inputs drive the joints %s", ", ".join(inputs))
        changes["driven_joints"] = driven = inputs
    settings = {"structure": matched} | ({} if driven is None else {"driven_joints": driven})
    return partial(model, **settings), changes


def _with_angles(model: Any, source: DataSource) -> tuple[ModelBuilder, dict[str, Any]]:
    """Set the angles of a network that has none, if coordinates of its data turn."""
    takes_angles = callable(model) and "angles" in inspect.signature(model).parameters
    if (
        isinstance(model, Predictor)
        or not takes_angles
        or "angles" in getattr(model, "keywords", {})
    ):
        return model, {}
    with naming("data"):
        angles = turning(source)
    if not angles:
        return model, {}
    names = ", ".join(source.labels[k] for k in angles)
    log.info("model.angles=%s: %s turns by more than a revolution", angles, names)
    return partial(model, angles=angles), {"angles": angles}


def turning(source: DataSource) -> list[int]:
    """Return the coordinates of a log in rad that turn by more than one revolution.

    A network that sees the unwrapped angle would have to learn the same mechanics for each
    revolution.
    """
    if not isinstance(source, LogSource):
        return []
    q = torch.cat([run.q for run in source.load().train])
    span = (q.amax(0) - q.amin(0)).tolist()
    units = source.q.units
    return [k for k, unit in enumerate(units) if unit == "rad" and span[k] > math.tau]


def _log_bodies(structure: RigidChain) -> None:
    """Name the bodies of the description that a fit does not start from."""
    same = (structure.prior_inertia() == structure.generic_inertia()).flatten(1).all(1).tolist()
    names = [name for name, generic in zip(structure.body_names, same, strict=True) if generic]
    if names:
        text = "<inertial> of %s is missing or impossible: the fit starts from rods along the links"
        log.info(text, ", ".join(names))
    if structure.tree.problems:
        log.warning("start=prior: %s", "; ".join(structure.tree.problems))


def match_structure(structure: RigidChain, source: DataSource) -> RigidChain:
    """Return the chain whose coordinates are the columns of q, in their order.

    All joints that no column names are held at zero. If the columns do not name joints, their
    number must be that of the joints, and their order counts.

    Raises:
        ConfigError: if the columns cannot be matched, or their units are not those of the joints.
    """
    signals = _signals(source)
    key, units = signals[0]
    columns, names = list(units), structure.joint_names
    candidates = structure.tree.movable if structure.joints is None else names
    joints = joints_of(columns, candidates)
    if joints is None:
        _check_order(key, columns, structure)
    elif joints != names:
        structure = structure.with_joints(joints)
        held = ", ".join(name for name in names if name not in joints) or "none"
        log.info("%s are the joints %s; held at zero: %s", key, ", ".join(joints), held)
    if structure.tree.held:
        log.info("the base is fixed, joints that are held: %s", ", ".join(structure.tree.held))
    if structure.tree.unread:
        log.warning("the model leaves out of the MJCF: %s", "; ".join(structure.tree.unread))
    names = structure.joint_names
    for (column, unit), joint, turns in zip(units.items(), names, structure.turning, strict=True):
        expected = "rad" if turns else "m"
        if unit not in ("", expected):
            raise ConfigError(
                f"{column} is in {unit}, expected {expected} for the joint {joint}, which "
                f"{'turns' if turns else 'slides'}: check the order of the columns, and the unit"
            )
    return structure


def _check_order(key: str, columns: Sequence[str], structure: RigidChain) -> None:
    """Refuse columns that the joints do not fit in their order, and log the pairs otherwise."""
    names = structure.joint_names
    matches = [_joint_of(column, names) for column in columns]
    matches = [None if matches.count(k) > 1 else k for k in matches]
    steps = {_number(x) - _number(y) for x, y in zip(columns, names, strict=False)}
    crossed = any(x not in (None, k) for k, x in enumerate(matches)) and len(steps) > 1
    if len(columns) != len(names) or (crossed and structure.joints is None):
        free = iter([name for k, name in enumerate(names) if k not in matches])
        guess = [next(free, "?") if k is None else names[k] for k in matches]
        joints = wording.setting("model.structure.joints", guess)
        way = f"name the joints of the columns in their order, as {joints}"
        raise ConfigError(
            f"{key} has the columns {', '.join(columns)}, and the structure the joints "
            f"{', '.join(names)}: {'leave out columns' if '?' in guess else way}"
        )
    _log_order(key, columns, names)


def _log_order(key: str, columns: Sequence[str], names: Sequence[str]) -> None:
    pairs = map(" -> ".join, zip(columns, names, strict=False))
    log.info("%s, column -> joint by their order: %s", key, "; ".join(pairs))


def _number(name: str) -> float:
    """Return the last number in a name, NaN without any."""
    digits = re.findall(r"\d+", name)
    return float(digits[-1]) if digits else math.nan


def check_known(model: KnownMechanics, source: DataSource) -> None:
    """Refuse known mechanics of other joints, or for inputs such as currents without gains."""
    names = model.structure.joint_names
    driven = [names[k] for k in model.driven]
    (key, q), *_, (input_key, u) = _signals(source)
    halves = [list(u)[k : k + len(driven)] for k in range(0, len(u), len(driven) or 1)]
    for name, columns, expected in (
        (key, list(q), names),
        *((input_key, x, driven) for x in halves),
    ):
        if (order := joints_of(columns, expected)) not in (None, expected):
            raise ConfigError(
                f"{name} has the order {', '.join(columns)}, and the model the joints "
                f"{', '.join(expected)}: build it with joints={order} or driven_joints={order}"
            )
    if model.gain is None and not model.drives.takes_targets:
        inputs = [
            f"{name} in {unit}"
            for (name, unit), gain in zip(u.items(), model.drives.strength().tolist(), strict=False)
            if unit not in ("", "N", "Nm") and gain == 1
        ]
        if inputs:
            raise ConfigError(
                f"the inputs are {', '.join(inputs)}, no forces: set drive gains, as "
                f"{wording.setting('model.drive_gain', 10)} and "
                f"{wording.setting('model.gain_spread', 0.5)}, or correct "
                f"{wording.setting('dataset.u.unit')}"
            )


def warn_of_log(model: Any, source: DataSource) -> None:
    """Warn of what the check of the log finds: whether it contradicts itself or the URDF."""
    if not isinstance(source, LogSource):
        return
    drives = model.drives if isinstance(model, KnownMechanics) else None
    structure = double_copy(model).structure if drives and not drives.takes_targets else None
    is_limited = drives is not None and drives.largest_input() is not None
    for text in verdict(source, structure):
        if not (is_limited and SATURATES in text):
            log.warning("%s: %s", source.name, text)


def _signals(source: DataSource) -> list[tuple[str, dict[str, str]]]:
    """Return the keys of q, v and u, each with names and units of its columns; "" if unknown."""
    if not isinstance(source, LogSource):
        labels = {
            wording.setting("dataset.labels"): source.labels,
            wording.setting("dataset.input_labels"): source.input_labels,
        }
        pairs = {
            k: [x.rstrip("]").partition(" [")[::2] for x in texts] for k, texts in labels.items()
        }
        return [(key, dict(texts)) for key, texts in pairs.items()]
    signals = []
    for key, x in {"q": source.q, "v": source.v, "u": source.u}.items():
        if x is not None:
            units = [
                "" if f == "1" else f if u == "1" else u
                for u, f in zip(x.units, x.unit, strict=True)
            ]
            path = wording.setting(f"dataset.{key}.columns")
            signals.append((path, dict(zip(x.columns, units, strict=True))))
    return signals


def joints_of(columns: Sequence[str], joints: Sequence[str]) -> list[str] | None:
    """Return the joint of each column, or None unless the columns name different joints.

    A column contains the name of its joint. Otherwise the names of joints may end as the columns do
    or with their numbers, all after the same prefix: panda_joint1 and q1.
    """
    names = [joints[k] for column in columns if (k := _joint_of(column, joints)) is not None]
    if len(set(names)) == len(columns):
        return names
    for pattern in ("(.*)", r".*?(\d*)\D*$"):  # the whole column, or its last number
        endings = [re.sub(pattern, r"\1", _letters(column)) for column in columns]
        prefixes = [
            {_letters(x)[: -len(end)]: x for x in joints if end and _letters(x).endswith(end)}
            for end in endings
        ]
        shared = set.intersection(*map(set, prefixes)) if len(joints) >= len(columns) else set()
        if len(shared) == 1 and len(set(endings)) == len(columns):
            (prefix,) = shared
            return [names_by_prefix[prefix] for names_by_prefix in prefixes]
    return None


def _joint_of(column: str, joints: Sequence[str]) -> int | None:
    """Return the joint with the longest name in that of a column: joint10 contains joint1."""
    lengths = []
    for name in map(_letters, joints):
        short = name.replace("joint", "")
        names = [name, short] if len(short) >= 3 else [name]  # any column may contain "a"
        lengths.append(max((len(text) for text in names if text in _letters(column)), default=0))
    longest = max(lengths)
    return lengths.index(longest) if longest and lengths.count(longest) == 1 else None


def _letters(name: str) -> str:
    """Return letters and digits: shoulder_pan, shoulder.pan and ShoulderPan are the same name."""
    return re.sub(r"[\W_]", "", name.lower())
