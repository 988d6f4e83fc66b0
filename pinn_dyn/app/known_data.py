"""Agreement of data and known mechanics: the order and the units of joints, inputs as forces."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence

from pinn_dyn.app.config import ConfigError
from pinn_dyn.data import DataSource, LogSource
from pinn_dyn.mechanics import Predictor
from pinn_dyn.models import KnownAndNetwork, KnownMechanics
from pinn_dyn.models.known import Structure

log = logging.getLogger(__name__)


def check_known(model: Predictor, source: DataSource) -> None:
    """Refuse known mechanics of other joints, or for inputs such as currents without gains."""
    model = model.known if isinstance(model, KnownAndNetwork) else model
    if not isinstance(model, KnownMechanics):
        return
    driven = [model.structure.joint_names[k] for k in model.driven]
    driven *= model.num_inputs // len(driven)  # targets and feed-forward forces
    check_structure("model.structure", model.structure, source, driven)
    if model.gain is None and model.servo is None:
        inputs = [
            f"{name} in {unit}"
            for (name, unit), gain in zip(
                _signals(source)[-1][1].items(), model.fixed_gain.tolist(), strict=False
            )
            if unit not in ("", "N", "Nm") and gain == 1
        ]
        if inputs:
            raise ConfigError(
                f"the inputs are {', '.join(inputs)}, no forces: set drive gains, as "
                "model.drive_gain=10 model.gain_spread=0.5, or correct dataset.u.unit"
            )


def check_structure(
    path: str, structure: Structure, source: DataSource, driven: Sequence[str] = ()
) -> None:
    """Refuse rigid bodies whose joints are not the data's.

    If the columns do not name the joints, their order counts. ``path`` is the structure's key,
    ``driven`` are the joints with an input; without them, fewer inputs than joints pass.

    Raises:
        ConfigError: if number, order or units of the columns are not those of the joints.
    """
    signals = _signals(source)
    for key, units in signals:
        columns, is_input = list(units), key in ("dataset.u.columns", "dataset.input_labels")
        joints = list(driven) if is_input and driven else structure.joint_names
        if is_input and not driven and len(columns) < len(joints):
            continue
        if len(columns) != len(joints):
            raise ConfigError(
                f"{key} has the columns {', '.join(columns)}, and {path} the joints "
                f"{', '.join(joints)}: leave out columns, or set {path}.locked_joints"
            )
        numbers = [_joint_of(column, joints) for column in columns]
        matches = [None if numbers.count(k) > 1 else k for k in numbers]
        if any(joint not in (None, k) for k, joint in enumerate(matches)):
            order = [columns[matches.index(k)] if k in matches else "?" for k in range(len(joints))]
            raise ConfigError(
                f"{key} has the order {', '.join(columns)}, and {path} has the joints "
                f"{', '.join(joints)}: expected {key}=[{','.join(order)}]"
            )
        if None in matches:
            pairs = map(" -> ".join, zip(columns, joints, strict=True))
            log.info("%s, column -> joint by their order: %s", key, "; ".join(pairs))
    for (name, unit), joint, turns in zip(
        signals[0][1].items(), structure.joint_names, structure.turning, strict=True
    ):
        expected = "rad" if turns else "m"
        if unit not in ("", expected):
            raise ConfigError(
                f"{name} is in {unit}, expected {expected} for the joint {joint} of {path}, which "
                f"{'turns' if turns else 'slides'}: check the order of the columns, and the unit"
            )


def _signals(source: DataSource) -> list[tuple[str, dict[str, str]]]:
    """Return the keys of q, v and u, each with names and units of its columns; "" if unknown."""
    if not isinstance(source, LogSource):
        labels = {"dataset.labels": source.labels, "dataset.input_labels": source.input_labels}
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
            signals.append((f"dataset.{key}.columns", dict(zip(x.columns, units, strict=True))))
    return signals


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
