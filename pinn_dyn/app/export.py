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
        ValueError: on another ending, or an MJCF of elastic joints or feed-forward forces.
        TypeError: if the model has no bodies.
    """
    path = Path(path).expanduser()
    if path.suffix not in _WRITERS:
        raise ValueError(f"{path} ends in {path.suffix!r}, expected {' or '.join(_WRITERS)}")
    structure = getattr(model, "structure", None)
    chain = getattr(structure, "chain", structure)  # the links of elastic joints
    if not isinstance(model, KnownMechanics) or not isinstance(chain, RigidChain):
        kind = type(model).__name__
        reason = "its network would be lost" if isinstance(model, KnownAndNetwork) else "no bodies"
        raise TypeError(f"a {kind} has no robot file ({reason}): export a run of model=known")
    if path.suffix == ".xml" and (model.elastic or model.num_inputs > len(model.driven)):
        kind = "elastic joints" if model.elastic else "feed-forward forces"
        raise ValueError(f"{path}: {kind} have no actuator of an MJCF, use the ending .urdf")
    model = double_copy(model)
    chain = chain.double()
    with torch.no_grad():
        offset, gain = model.constant_force(), model.input_gain() @ model.motors
        bias, limit = [offset, 0 * offset, 0 * offset], torch.full_like(offset, torch.inf)
        if servo := model.servo:
            gain = servo.springs()
            bias = [offset, -gain, -servo.damping_rates()]
            limit[model.driven] = torch.inf if servo.affine else servo.largest_force()
        drives = model.physical_constants()[_BODY_COLUMNS:]
        fast = torch.full_like(model.viscous(), torch.inf)
        constants = RobotConstants(
            inertia=model.bodies(),
            armature=model.rotor_inertia(),
            damping=model.viscous(),
            friction=(model.friction(fast) - model.friction(-fast)) / 2,
            gain=gain,
            bias=torch.stack(bias, dim=-1),
            limit=limit,
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
    write_whole(path, _WRITERS[path.suffix](chain, constants, path.parent))
    return path
