"""Convert the robot of an MJCF file to a URDF, with the compiler of MuJoCo."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from torch import Tensor

_KINDS = ("floating", "spherical", "prismatic", "revolute")  # free, ball, slide and hinge
_LOOKS = ("skins", "materials", "textures", "hfields")
_UNUSED = (*_LOOKS, "keys", "sensors", "actuators", "tendons", "pairs")


def mjcf_to_urdf(source: Path | str) -> str:
    """Return a URDF of the robot in an MJCF file or text.

    All frames are parallel to the world frame at qpos = 0. A body with several joints gets
    massless links between them. Bodies without ``<inertial>`` have the inertia of their geoms, or
    an unknown inertia if their meshes are missing. A site becomes a massless link. A linear
    equality of two joints becomes a ``<mimic>``. A ``<note>`` names each effect that a URDF cannot
    express.

    Raises:
        ImportError: without MuJoCo.
        ValueError: if MuJoCo cannot compile the file.
    """
    try:
        import mujoco
    except ImportError as error:
        text = "an MJCF file needs MuJoCo: pip install 'pinn_dyn[mujoco]'"
        raise ImportError(text) from error
    try:
        model, unknown = _compiled(mujoco, source)
    except ValueError as error:
        name = source if isinstance(source, Path) else "MJCF text"
        raise ValueError(f"{name}: {' '.join(str(error).split())}") from error
    data = mujoco.MjData(model)
    kinds = [_KINDS[k] for k in model.jnt_type]
    notes = _unread(mujoco, model)
    scalar = [j for j, kind in enumerate(kinds) if kind not in _KINDS[:2]]
    data.qpos[model.jnt_qposadr[scalar]] = 0
    mujoco.mj_kinematics(model, data)
    links = [model.body(k).name for k in range(model.nbody)]
    joints = [model.joint(j).name or f"joint{j}" for j in range(model.njnt)]
    mimics = _mimics(mujoco, model, joints)
    parts = ['<link name="world"/>', *(f"<note>{escape(note)}</note>" for note in notes)]
    frames = data.xpos.copy()
    for body in range(1, model.nbody):
        parent = model.body_parentid[body]
        link, origin = links[parent], frames[parent]
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        for j in range(first, first + count):
            anchor = frames[body] = data.xanchor[j]
            is_last = j == first + count - 1
            child = links[body] if is_last else f"{links[body]} before {joints[j + 1]}"
            if not is_last:
                parts.append(f"<link name={quoteattr(child)}/>")
            is_free = kinds[j] == "revolute" and not model.jnt_limited[j]
            kind = "continuous" if is_free else kinds[j]
            low, high = model.jnt_range[j]
            effort = model.jnt_actfrcrange[j, 1]
            details = f'<axis xyz="{exact_text(data.xaxis[j])}"/>{mimics.get(j, "")}'
            details += f'<limit lower="{low}" upper="{high}" velocity="0" effort="{effort}"/>'
            parts.append(_joint(joints[j], kind, link, child, anchor - origin, details))
            link, origin = child, anchor
        if not count:
            weld = f"weld of {links[body]}"
            parts.append(_joint(weld, "fixed", link, links[body], frames[body] - origin))
        inertial = '<inertial><mass value="unknown"/></inertial>' if links[body] in unknown else ""
        if not inertial and model.body_mass[body] > 0:
            inertial = _inertial(model, data, body, frames[body])
        parts.append(f"<link name={quoteattr(links[body])}>{inertial}</link>")
    for k in range(model.nsite):
        if (site := model.site(k).name) and site not in links:
            body = model.site_bodyid[k]
            offset = data.site_xpos[k] - frames[body]
            parts.append(f"<link name={quoteattr(site)}/>")
            parts.append(_joint(f"place of {site}", "fixed", links[body], site, offset))
    return f"<robot>{''.join(parts)}</robot>"


def _compiled(mujoco: Any, source: Path | str) -> tuple[Any, set[str]]:
    """Return the compiled robot, and the names of bodies with unknown inertia.

    Materials, and geoms without influence on the inertia, are left out.
    """
    is_file = isinstance(source, Path)
    spec = mujoco.MjSpec.from_file(str(source)) if is_file else mujoco.MjSpec.from_string(source)
    for kind in _UNUSED:
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    forced = int(spec.compiler.inertiafromgeom) == 1  # geoms replace every <inertial>
    for element in [*spec.geoms, *spec.sites]:
        element.material = ""
    for geom in list(spec.geoms):
        weightless = geom.density == 0 or geom.mass == 0
        explicit = geom.parent.explicitinertial and not forced
        if geom.parent.name == "world" or weightless or explicit:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in [x for x in spec.meshes if (x.name or Path(x.file).stem) not in used]:
        spec.delete(mesh)
    for k, body in enumerate(spec.bodies):
        body.name = body.name or f"body{k}"
    try:
        return spec.copy().compile(), set()
    except ValueError as error:
        if not any(word in str(error) for word in ("file", "mass and inertia")):
            raise
    return _without_meshes(spec)


def _without_meshes(spec: Any) -> tuple[Any, set[str]]:
    """Return the robot compiled with 1 kg for bodies of unknown inertia, and their names."""
    unknown = {geom.parent.name for geom in spec.geoms if geom.meshname}
    for element in [*(geom for geom in spec.geoms if geom.meshname), *spec.meshes]:
        spec.delete(element)
    for body in spec.bodies[1:]:
        empty = body.joints and not body.geoms and not body.explicitinertial
        if empty or body.name in unknown:
            unknown.add(body.name)
            body.explicitinertial, body.mass, body.inertia = True, 1.0, [1.0, 1.0, 1.0]
    return spec.compile(), unknown


def _unread(mujoco: Any, model: Any) -> list[str]:
    """Return the names of effects in the MJCF that a URDF cannot express."""
    is_joint = model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)
    closed = model.eq_active0.astype(bool) & ~(is_joint & ~model.eq_data[:, 2:5].any(1))
    effects = {
        "springs of joints": model.jnt_stiffness.any(),
        "gravity compensation": model.body_gravcomp.any(),
        "closed loops and nonlinear equalities": closed.any(),
    }
    notes = [name for name, is_present in effects.items() if is_present]
    if not np.allclose(gravity := model.opt.gravity, [0, 0, -9.81], atol=0.02):
        text = ",".join(f"{x:g}" for x in gravity)
        notes.append(f"gravity (set model.structure.gravity=[{text}])")
    return notes


def _mimics(mujoco: Any, model: Any, joints: list[str]) -> dict[int, str]:
    """Return the ``<mimic>`` of each joint j with q_j - q_j0 = a0 + a1 (q_i - q_i0)."""
    mimics = {}
    for k in np.flatnonzero(model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)):
        follower, master = model.eq_obj1id[k], model.eq_obj2id[k]
        factors = model.eq_data[k, :5]
        if model.eq_active0[k] and master >= 0 and not factors[2:].any():
            start, driver = model.qpos0[model.jnt_qposadr[[follower, master]]]
            offset = start + factors[0] - factors[1] * driver
            mimics[follower] = (
                f'<mimic joint={quoteattr(joints[master])} multiplier="{factors[1]}" '
                f'offset="{offset}"/>'
            )
    return mimics


def _joint(
    name: str, kind: str, parent: str, child: str, origin: np.ndarray, details: str = ""
) -> str:
    return (
        f'<joint name={quoteattr(name)} type="{kind}"><parent link={quoteattr(parent)}/>'
        f'<child link={quoteattr(child)}/><origin xyz="{exact_text(origin)}"/>{details}</joint>'
    )


def _inertial(model: Any, data: Any, body: int, origin: np.ndarray) -> str:
    axes = data.ximat[body].reshape(3, 3)
    moments = axes * model.body_inertia[body] @ axes.T
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    pairs = zip(keys, moments[np.triu_indices(3)], strict=True)
    text = " ".join(f'{key}="{moment}"' for key, moment in pairs)
    return (
        f'<inertial><mass value="{model.body_mass[body]}"/><inertia {text}/>'
        f'<origin xyz="{exact_text(data.xipos[body] - origin)}"/></inertial>'
    )


def exact_text(values: Iterable[float] | Tensor) -> str:
    """Return numbers as the text of an XML attribute, without rounding."""
    return " ".join(repr(float(value)) for value in values)
