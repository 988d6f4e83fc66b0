"""Files of a trained model for other programs."""

from __future__ import annotations

from pathlib import Path

import torch

from pinn_dyn import __version__
from pinn_dyn.data.whole import write_whole
from pinn_dyn.mechanics import Predictor, double_copy
from pinn_dyn.models import KnownAndNetwork, KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.systems.robot_files import RobotConstants, new_mjcf, updated_urdf

_WRITERS = {".urdf": updated_urdf, ".xml": new_mjcf}
_BODY_COLUMNS = 10  # of physical_constants


def export(model: Predictor, path: str | Path) -> Path:
    """Write the identified robot to a URDF (``.urdf``) or an MJCF (``.xml``).

    Raises:
        ValueError: on another ending.
        TypeError: if the model has no bodies.
    """
    path = Path(path).expanduser()
    if path.suffix not in _WRITERS:
        raise ValueError(f"{path} ends in {path.suffix!r}, expected {' or '.join(_WRITERS)}")
    structure = getattr(model, "structure", None)
    if not isinstance(model, KnownMechanics) or not isinstance(structure, RigidChain):
        kind = type(model).__name__
        reason = "its network would be lost" if isinstance(model, KnownAndNetwork) else "no bodies"
        raise TypeError(f"a {kind} has no robot file ({reason}): export a run of model=known")
    model = double_copy(model)
    structure = structure.double()
    with torch.no_grad():
        drives = model.physical_constants()[_BODY_COLUMNS:]
        fast = torch.full_like(model.viscous(), torch.inf)
        constants = RobotConstants(
            inertia=model.bodies(),
            armature=model.rotor_inertia(),
            damping=model.viscous(),
            friction=(model.friction(fast) - model.friction(-fast)) / 2,
            gain=model.input_gain() @ model.motors,
            offset=model.constant_force(),
            notes=[
                f"Inertias, damping and friction identified by pinn_dyn {__version__}. Drives:",
                *(
                    f"{name} = {float(value):.6g} {unit}"
                    for part in drives
                    for name, unit, value in zip(*part[:3], strict=True)
                ),
            ],
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, _WRITERS[path.suffix](structure, constants, path.parent))
    return path
