"""Identified robots written to URDF and MJCF, against Pinocchio, MuJoCo and Bullet."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from pinn_dyn.models import KnownMechanics, NoFriction, Servo, Stribeck
from pinn_dyn.run.export import export
from pinn_dyn.run.run_folder import with_structures
from pinn_dyn.systems import RigidChain
from tests.support.arm_urdf import ARM
from tests.support.known import elastic_model, statistics
from tests.support.rigid_chains import TREE

mujoco = pytest.importorskip("mujoco", reason="the mujoco extra is not installed")
pinocchio = pytest.importorskip("pinocchio", reason="the dev extra is not installed")
FINGERS = ["panda_finger_joint1", "panda_finger_joint2"]
BOX = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
MJCF = """<mujoco><worldbody><body name="arm" pos="0 0 1" euler="20 30 40">
  <joint name="pitch" axis="0 1 0"/><joint name="roll" axis="1 0 0" pos="0 0 0.1"/>
  <geom size="0.1"/><body pos="0.3 0 0" euler="10 0 5"><geom type="box" size="0.1 0.2 0.1"/>
  <joint name="slide" type="slide" axis="0 0 1"/></body></body></worldbody></mujoco>"""
# Branches, prismatic and reversed joints, fixed links and locked joints.
ROBOTS = {
    "tree": (TREE.replace('<link name="bracket">', f'<link name="bracket">{BOX}'), ["wrist"]),
    "spatial": (TREE, ["fork", "slide"]),
    "springs": (TREE, ["wrist"], Stribeck, ["slide", "bend"]),
    "mjcf": (MJCF, []),
    "panda": ("franka_panda/panda.urdf", FINGERS),
}
FORK = '<joint name="fork" type="revolute">'
STATES = 10


def learned(urdf, locked=(), friction=Stribeck, springs=(), **settings):
    """A model in double precision with random constants."""
    structure = RigidChain(urdf, locked_joints=locked, payload=0.7)
    scales = statistics(structure.num_coordinates)
    if driven := settings.get("driven_joints"):
        inputs = torch.ones(len(driven)).double()
        scales = replace(scales, u_mean=0 * inputs, u_std=inputs)
    settings = {"friction": friction, "springs": springs, **settings}
    model = KnownMechanics(scales, structure, **settings).double()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(0.3 * torch.randn(parameter.shape, generator=generator))
    return model.requires_grad_(False)


def states(size):
    return torch.randn(3, STATES, size, generator=torch.Generator().manual_seed(1)).double()


def pinocchio_forces(path, names, q, v, a):
    """Inverse dynamics without armatures and friction, in the order of the names."""
    model = pinocchio.buildModelFromUrdf(str(path))
    data, order = model.createData(), [names.index(name) for name in list(model.names)[1:]]
    forces = np.empty_like(q)
    for k, row in enumerate(q):
        angles = []
        for joint, angle in zip(list(model.joints)[1:], row[order], strict=True):
            angles += [angle] if joint.nq == 1 else [np.cos(angle), np.sin(angle)]
        tau = pinocchio.rnea(model, data, np.array(angles), v[k][order], a[k][order])
        forces[k, order] = tau
    return forces


def mujoco_forces(path, names, q, v, a):
    """Inverse dynamics without the dry friction, which is a constraint there."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data, order = mujoco.MjData(model), [model.joint(name).id for name in names]
    forces = np.empty_like(q)
    for k in range(len(q)):
        data.qpos[order], data.qvel[order], data.qacc[order] = q[k], v[k], a[k]
        mujoco.mj_inverse(model, data)
        forces[k] = data.qfrc_inverse[order]
    return forces


@pytest.mark.parametrize("name", ROBOTS)
def test_an_exported_robot_has_the_learned_dynamics_elsewhere(name, tmp_path, caplog):
    model = learned(*ROBOTS[name])
    structure, names = model.structure, model.structure.joint_names
    q, v, a = (x.numpy() for x in states(len(names)))
    rigid = structure.rigid_force(*map(torch.from_numpy, (q, v, a)), model.bodies()).numpy()
    drives = model.rotor_inertia().numpy() * a + model.viscous().numpy() * v
    if name == "springs":
        stiffness, rest = (part.values.numpy() for part in model.physical_constants()[-2:])
        drives[:, 1:3] += stiffness * (q[:, 1:3] - rest)
    urdf, mjcf = (export(model, tmp_path / f"arm.{ending}") for ending in ("urdf", "xml"))
    assert ("a URDF has no springs" in caplog.text) == (name == "springs")
    scale = np.abs(rigid).max()
    np.testing.assert_allclose(
        pinocchio_forces(urdf, names, q, v, a), rigid, rtol=0, atol=1e-9 * scale
    )
    np.testing.assert_allclose(
        mujoco_forces(mjcf, names, q, v, a), rigid + drives, rtol=0, atol=1e-9 * scale
    )
    again = RigidChain(str(urdf)).mass_matrix(torch.from_numpy(q))
    torch.testing.assert_close(again, structure.mass_matrix(torch.from_numpy(q), model.bodies()))


@pytest.mark.parametrize("limit", [None, 3.0, "learned"])
def test_a_servo_becomes_an_actuator_with_the_same_forces(tmp_path, limit):
    """At a fifth of the limit, and far beyond: in between, the limit of the model is smooth."""
    model = learned(TREE, ["wrist"], NoFriction, input=partial(Servo, limit=limit, stiffness=8.0))
    q, v, _ = states(len(model.driven))
    largest = torch.inf if limit is None else model.drives.largest_force()
    mjcf = mujoco.MjModel.from_xml_path(str(export(model, tmp_path / "arm.xml")))
    data = mujoco.MjData(mjcf)
    order = [mjcf.joint(name).id for name in model.structure.joint_names]
    drives = [mjcf.actuator(name).id for name in model.structure.joint_names]
    for size in (0.1, 1e3):
        s = size * (torch.ones_like(q) if limit is None else largest) * q.sign()
        u = q + (s + model.drives.damping_rates() * v) / model.drives.spring_constant()
        expected = s.clamp(-largest, largest) if limit else s
        expected = expected + model.constant_force()
        for k in range(STATES):
            data.qpos[order], data.qvel[order], data.ctrl[drives] = q[k], v[k], u[k]
            mujoco.mj_forward(mjcf, data)
            np.testing.assert_allclose(data.qfrc_actuator[order], expected[k], rtol=1e-6)
        torch.testing.assert_close(
            model.motor_force(q, v, u) + model.constant_force(), expected, rtol=1e-6, atol=1e-6
        )


def test_the_links_of_elastic_joints_are_written_to_a_urdf(tmp_path):
    model = elastic_model()
    chain = model.structure.chain
    q, v, a = states(chain.num_coordinates)
    path = export(model, tmp_path / "arm.urdf")
    forces = pinocchio_forces(path, chain.joint_names, *(x.numpy() for x in (q, v, a)))
    np.testing.assert_allclose(
        forces, chain.rigid_force(q, v, a, model.bodies().detach()), atol=1e-9
    )
    with pytest.raises(ValueError, match=r"use the ending \.urdf"):
        export(model, tmp_path / "arm.xml")


BEND = '<joint name="bend" type="continuous">'
MIMIC = '<mimic joint="turn" multiplier="-0.7" offset="0.2"/>'


@pytest.mark.parametrize(
    ("urdf", "locked"),
    [
        (TREE, {"slide": 0.1, "wrist": -1.2}),
        (TREE, {"turn": 0.7, "fork": 1.57}),
        (TREE.replace(BEND, BEND + MIMIC), {"turn": 0.7}),
    ],
)
def test_locked_joints_are_fixed_where_they_are_held(tmp_path, urdf, locked):
    model = learned(urdf, locked)
    structure, names = model.structure, model.structure.joint_names
    q, v, a = states(len(names))
    rigid = structure.rigid_force(q, v, a, model.bodies()).numpy()
    motion = names, q.numpy(), v.numpy(), a.numpy()
    np.testing.assert_allclose(
        pinocchio_forces(export(model, tmp_path / "arm.urdf"), *motion), rigid, atol=1e-9
    )
    drives = (model.rotor_inertia() * a + model.viscous() * v).numpy()
    np.testing.assert_allclose(
        mujoco_forces(export(model, tmp_path / "arm.xml"), *motion), rigid + drives, atol=1e-9
    )


def test_a_joint_that_follows_another_still_does(tmp_path):
    """The forces of both joints add up at the coordinate."""
    model = learned(TREE.replace(FORK, FORK + MIMIC), ["slide", "bend", "wrist"])
    assert model.structure.joint_names == ["turn"]
    q, v, a = states(1)
    rigid = model.structure.rigid_force(q, v, a, model.bodies())
    again = RigidChain(str(export(model, tmp_path / "arm.urdf")))
    torch.testing.assert_close(again.rigid_force(q, v, a), rigid)
    drives = model.rotor_inertia() * a + model.viscous() * v
    factors = np.array([1, -0.7])
    both = [x.numpy() * factors for x in (q, v, a)]
    forces = mujoco_forces(export(model, tmp_path / "arm.xml"), ["turn", "fork"], *both)
    np.testing.assert_allclose(forces @ factors, (rigid + drives)[:, 0], atol=1e-9)


def test_friction_gains_and_offsets_are_in_the_files(tmp_path):
    """MuJoCo computes the torque of the drives from the input."""
    model = learned(ARM, gain_spread=0.3, drive_gain=20.0, driven_joints=["elbow"])
    level = (model.friction(torch.tensor([1e6])) - model.friction(torch.tensor([-1e6]))) / 2
    fields = pinocchio.buildModelFromUrdf(str(export(model, tmp_path / "arm.urdf")))
    np.testing.assert_allclose(fields.damping, model.viscous())
    np.testing.assert_allclose(fields.upperDryFrictionLimit, level)
    arm = mujoco.MjModel.from_xml_path(str(export(model, tmp_path / "arm.xml")))
    np.testing.assert_allclose(arm.dof_frictionloss, level)
    np.testing.assert_allclose(arm.jnt_range[0], [-1.5, 1.5])
    data = mujoco.MjData(arm)
    data.ctrl[:] = 0.7
    mujoco.mj_forward(arm, data)
    expected = model.constant_force() + 0.7 * model.drive_gain() * torch.tensor([0, 1])
    np.testing.assert_allclose(data.qfrc_actuator, expected, atol=1e-12)
    assert "drive gain of elbow" in (tmp_path / "arm.urdf").read_text()


SHAPE = '<visual><geometry><mesh filename="meshes/upper.stl"/></geometry></visual>'


def test_an_export_keeps_the_file_of_the_robot_while_it_is_the_same(tmp_path, caplog):
    """A run has the text of its robot without shapes, and the path of the file."""
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "upper.stl").touch()
    file = tmp_path / "arm.urdf"
    text = ARM.replace('<link name="upper">', f'<link name="upper">{SHAPE}')
    file.write_text(text)
    stored = with_structures({"_target_": "pinn_dyn.systems.RigidChain", "urdf": str(file)})["urdf"]
    model = learned(stored, friction=NoFriction)
    kept = export(model, tmp_path / "out" / "new.urdf").read_text()
    assert 'filename="../meshes/upper.stl"' in kept
    assert 'velocity="0.5"' in kept
    file.write_text(text.replace("0 0 -0.5", "0 0 -0.6"))
    changed = export(model, tmp_path / "new.urdf")
    assert "changed after the training" in caplog.text
    q = states(2)[0]
    again = RigidChain(str(changed)).mass_matrix(q)
    torch.testing.assert_close(again, model.structure.mass_matrix(q, model.bodies()))
    assert Path(changed).read_text().count("mesh") == 0
