"""Files of a trained model for other programs."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from pinn_dyn import __version__
from pinn_dyn.atomic_files import write_whole
from pinn_dyn.control.export import NAME, external_torque_function
from pinn_dyn.exports.exported_function import ENDINGS, Ranges, Real, write
from pinn_dyn.exports.model_functions import model_functions
from pinn_dyn.mechanics import MechanicalSystem, Predictor, double_copy
from pinn_dyn.models import KnownAndNetwork, KnownMechanics, Statistics
from pinn_dyn.models.subspace_encoder import EncodedPredictor
from pinn_dyn.systems import HasDomain, RigidChain
from pinn_dyn.systems.robot_files import RobotConstants, new_mjcf, updated_urdf

log = logging.getLogger(__name__)

_WRITERS = {".urdf": updated_urdf, ".xml": new_mjcf}
_BODY_COLUMNS = 10  # of physical_constants


def export(
    model: Predictor,
    path: str | Path,
    what: str | None = None,
    *,
    real: Real = "double",
    statistics: Statistics | None = None,
    about: Mapping[str, Any] | None = None,
) -> Path:
    """Write a model to a file for other programs, in the format of the ending of the path.

    - ``.c`` (with ``.h``): the functions of :func:`~.exports.model_functions.model_functions`;
    - ``.onnx``, ``.casadi``: a single one of these functions;
    - ``.urdf``, ``.xml`` (MJCF): the identified robot of a run of model=known.

    Args:
        model: a model or a known system.
        path: the file.
        what: name of the function. The default is all functions in a ``.c`` file, otherwise
            ``forward_dynamics``, or ``next_state`` of a model without it. ``external_torque`` is
            the function of :func:`~.control.external_torque.external_torque_function`.
        real: type of the numbers in a ``.c`` or ``.onnx`` file.
        statistics: of the training data. The file is compared with the model in their ranges, or
            within [-1, 1] and the domain of the equation of motion.
        about: fields for the information in the file, such as names of coordinates.

    Raises:
        ValueError: on another ending or function, or an MJCF of elastic joints or feed-forward
            forces.
        TypeError: if the format cannot hold the model.
        RuntimeError: if the file differs from the model, see
            :func:`~.exports.exported_function.write`.
    """
    path = Path(path).expanduser()
    if path.suffix in _WRITERS:
        return _export_robot(model, path)
    if path.suffix not in ENDINGS:
        endings = ", ".join([*ENDINGS, *_WRITERS])
        raise ValueError(f"{path} ends in {path.suffix!r}, expected one of {endings}")
    model = double_copy(model).requires_grad_(False)
    ranges = _within_domain(model) if statistics is None else ranges_of(statistics)
    if what == NAME and isinstance(model, MechanicalSystem):
        functions = [external_torque_function(model, ranges)]
    else:
        functions = model_functions(model, ranges)
    names = [function.name for function in functions]
    if what is None and path.suffix != ".c":
        what = names[0]
    if what not in (None, *names):
        raise ValueError(f"what is {what!r}, expected one of {', '.join(names)}")
    info = {
        "model": type(model).__name__,
        "num_coordinates": model.num_coordinates,
        "num_inputs": model.num_inputs,
        **(about or {}),
    }
    if isinstance(model, EncodedPredictor):
        info["memory_size"] = model.memory_size
    return write([f for f in functions if what in (None, f.name)], path, info, real)


def export_samples(models: Sequence[Predictor], path: str | Path) -> Path:
    """Write a URDF or MJCF of each model, and a table of their constants; return its path.

    Raises:
        ValueError: on another ending.
        TypeError: as :func:`export`.
    """
    path = Path(path).expanduser()
    if path.suffix not in _WRITERS:
        raise ValueError(f"{path} ends in {path.suffix!r}: samples are .urdf or .xml files")
    digits, rows = len(str(len(models) - 1)), []
    for k, model in enumerate(models):
        file = export(model, path.with_stem(f"{path.stem}_{k:0{max(digits, 2)}}"))
        row: dict[str, Any] = {"file": file.name}
        for part in getattr(model, "physical_constants", list)():
            for name, unit, value in zip(part.names, part.units, part.values, strict=True):
                row[f"{name} [{unit}]"] = float(value)
        rows.append(row)
    table = path.with_name(f"{path.stem}_samples.csv")
    write_whole(table, pd.DataFrame(rows).to_csv(index=False))
    return table


def ranges_of(statistics: Statistics) -> Ranges:
    """Return the range of q in the training data, and two standard deviations of v, a and u."""
    v, a, u = 2 * statistics.v_std, 2 * statistics.acceleration, statistics.u_mean
    h = torch.tensor(statistics.step)
    return {
        "q": (statistics.q_low, statistics.q_high),
        "v": (-v, v),
        "a": (-a, a),
        "u": (u - 2 * statistics.u_std, u + 2 * statistics.u_std),
        "h": (0.5 * h, h),
    }


def _within_domain(model: Predictor) -> Ranges:
    """Return a range of q in which the equation of motion holds, at most [-1, 1]."""
    radius = torch.ones(model.num_coordinates, dtype=torch.float64)
    if isinstance(model, HasDomain):
        for _ in range(10):
            try:
                model.check_domain(-radius.numpy(), radius.numpy())
                break
            except ValueError:
                radius = radius / 2
    return {"q": (-radius, radius)}


def _export_robot(model: Predictor, path: Path) -> Path:
    structure = getattr(model, "structure", None)
    chain = getattr(structure, "chain", structure)  # the links of elastic joints
    if not isinstance(model, KnownMechanics) or not isinstance(chain, RigidChain):
        kind = type(model).__name__
        reason = (
            "its network would be lost" if isinstance(model, KnownAndNetwork) else "nothing fitted"
        )
        raise TypeError(f"a {kind} has no robot file ({reason}): export a run of model=known")
    if path.suffix == ".xml" and (model.elastic or model.num_inputs > len(model.driven)):
        kind = "elastic joints" if model.elastic else "feed-forward forces"
        raise ValueError(f"{path}: {kind} have no actuator of an MJCF, use the ending .urdf")
    if path.suffix == ".urdf" and model.springs is not None:
        log.warning("%s: a URDF has no springs of joints, they are in a comment; use .xml", path)
    model = double_copy(model)
    chain = chain.double()
    with torch.no_grad():
        drives, offset = model.drives, model.offset() @ model.offset_joints
        stiffness = rest = zero = torch.zeros_like(offset)
        if model.springs is not None:
            side = model.springs.stretch
            stiffness = model.springs.stiffness() @ side
            rest = model.springs.rest_positions() @ side
        limit = torch.full_like(offset, torch.inf)
        if not drives.affine:
            limit[model.driven] = drives.largest_force()
        springs, damping = (
            zero if x is None else x for x in (drives.springs(), drives.damping_rates())
        )
        constants_of_drives = model.physical_constants()[_BODY_COLUMNS:]
        fast = torch.full_like(model.viscous(), torch.inf)
        constants = RobotConstants(
            inertia=model.bodies(),
            armature=model.rotor_inertia(),
            damping=model.viscous(),
            friction=(model.friction(fast) - model.friction(-fast)) / 2,
            gain=springs if drives.takes_targets else drives.strength() @ drives.selection,
            bias=torch.stack([offset, -springs, -damping], dim=-1),
            limit=limit,
            stiffness=stiffness,
            rest=rest,
            notes=[
                f"Inertias, damping and friction identified by pinn_dyn {__version__}. Drives:",
                *(
                    f"{name} = {float(value):.6g} {unit}"
                    for part in constants_of_drives
                    for name, unit, value in zip(*part[:3], strict=True)
                ),
            ],
        )
    for name, values in constants._asdict().items():
        if name not in ("limit", "notes") and not values.isfinite().all():
            raise ValueError(
                f"{path}: {name} is {values.tolist()}, expected finite numbers; the dry friction "
                "of a robot file has an upper limit"
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, _WRITERS[path.suffix](chain, constants, path.parent))
    return path
