"""Robots from MJCF files against MuJoCo."""

import sys

import numpy as np
import pytest
import torch

from pinn_dyn.systems import RigidChain
from pinn_dyn.systems.urdf import urdf_text

mujoco = pytest.importorskip("mujoco", reason="the mujoco extra is not installed")

# Several joints of a body, joints that do not start at zero, a ref, geoms as inertia, a weld, a
# coupled joint with an offset, a missing texture and a free object.
ARM = """<mujoco><compiler angle="degree" autolimits="true"/>
  <default><geom density="900"/><joint damping="0.3"/></default>
  <asset><texture name="t" type="2d" file="missing.png"/><material name="m" texture="t"/></asset>
  <worldbody><geom type="plane" size="1 1 1" material="m"/>
    <body name="column" pos="0.1 0 0.2" euler="10 20 30">
      <joint name="pan" axis="0 0 1" actuatorfrcrange="-3 7"/>
      <joint name="tilt" axis="0 1 0.2" pos="0 0 0.05" ref="15"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.02 0 0.3" material="m"/>
      <body name="tool" pos="0 0 0.3" euler="0 40 0">
        <geom type="box" size="0.05 0.04 0.03" pos="0.03 0 0"/>
        <body pos="0.1 0 0"><joint name="rail" type="slide" axis="1 0 1" range="0 0.1" ref="0.05"/>
          <inertial mass="0.4" pos="0 0.01 0.02" fullinertia="1e-3 2e-3 2.5e-3 1e-4 2e-4 -1e-4"/>
          <geom type="sphere" size="0.3"/><site name="tcp" pos="0.1 0 0"/>
          <body name="finger"><joint name="grip" type="slide" axis="0 1 0" ref="0.01"/>
            <geom type="sphere" size="0.02" pos="0 0.05 0"/></body></body></body></body>
    <body name="cup"><freejoint/><geom type="sphere" size="0.02"/></body></worldbody>
  <equality><joint joint1="grip" joint2="rail" polycoef="0.02 -0.5 0 0 0"/></equality>
  <actuator><motor joint="pan"/></actuator><keyframe><key name="home"/></keyframe>
</mujoco>"""


def forces_of(model, names, q, v):
    """M and the bias C v + G of the named joints in MuJoCo, without armature."""
    data = mujoco.MjData(model)
    ids = [model.joint(name).id for name in names]
    rows = model.jnt_dofadr[ids]
    data.qpos[model.jnt_qposadr[ids]], data.qvel[rows] = q, v
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    mass -= np.diag(model.dof_armature)
    return mass[np.ix_(rows, rows)], data.qfrc_bias[rows]


def assert_equals_mujoco(chain, model, seed=0):
    names = chain.joint_names
    q, v = np.random.default_rng(seed).uniform(-1, 1, (2, len(names)))
    mass, bias = chain.mass_and_bias(torch.from_numpy(q), torch.from_numpy(v))
    expected = forces_of(model, names, q, v)
    for ours, theirs in zip((mass, bias), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * np.abs(theirs).max())


@pytest.fixture
def model():
    return mujoco.MjModel.from_xml_string(
        ARM.replace(' file="missing.png"', ' builtin="flat" width="8" height="8"')
    )


def test_a_chain_of_an_mjcf_equals_mujoco(model):
    free = ["pan", "tilt", "rail", "grip"]
    assert_equals_mujoco(RigidChain(ARM, joints=free), model)
    assert_equals_mujoco(RigidChain(ARM, joints=free[::-1]), model)
    chain, data = RigidChain(ARM, joints=free, tip="tcp"), mujoco.MjData(model)
    q = data.qpos[model.jnt_qposadr[[model.joint(name).id for name in free]]] = [1, -1, 0.2, 0.1]
    mujoco.mj_forward(model, data)
    tip = chain.tip_position(torch.tensor(q).double())
    np.testing.assert_allclose(tip, data.site("tcp").xpos, atol=1e-12)
    np.testing.assert_allclose(chain.limits[[0, 2], :2], [[-np.pi, np.pi], [0, 0.1]])
    assert chain.limits[0, 3] == 7


def test_an_equality_of_joints_is_a_mimic_joint(model):
    chain = RigidChain(ARM)
    assert (chain.joint_names, len(chain.body_names)) == (["pan", "tilt", "rail"], 4)
    assert len(chain.tree.held) == 1  # the free joint of the cup
    q, v = np.random.default_rng(1).uniform(-0.1, 0.1, (2, 3))
    # q_grip - 0.01 = 0.02 - 0.5 (q_rail - 0.05)
    jacobian = np.vstack([np.eye(3), [0, 0, -0.5]])
    names = ["pan", "tilt", "rail", "grip"]
    mass, bias = forces_of(model, names, jacobian @ q + [0, 0, 0, 0.055], jacobian @ v)
    ours = chain.mass_and_bias(torch.from_numpy(q), torch.from_numpy(v))
    np.testing.assert_allclose(ours[0], jacobian.T @ mass @ jacobian, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours[1], jacobian.T @ bias, rtol=0, atol=1e-12)


def test_the_text_of_an_mjcf_with_includes_loads_without_mujoco(tmp_path, monkeypatch):
    body = ARM[ARM.index('<body name="column"') : ARM.index('<body name="cup"')]
    (tmp_path / "arm.xml").write_text(f"<mujocoinclude>{body}</mujocoinclude>")
    (tmp_path / "scene.xml").write_text(ARM.replace(body, '<include file="arm.xml"/>'))
    chain, text = RigidChain(ARM), urdf_text(str(tmp_path / "scene.xml"))
    assert "scene.xml" in text
    monkeypatch.setitem(sys.modules, "mujoco", None)
    stored = RigidChain(text)
    assert stored.joint_names == chain.joint_names
    torch.testing.assert_close(stored.inertia, chain.inertia)
    with pytest.raises(ImportError, match=r"pip install 'pinn_dyn\[mujoco\]'"):
        RigidChain(ARM)


def test_missing_meshes_leave_the_kinematics_and_are_a_problem_of_a_prior_only():
    mesh = '<asset><mesh name="shell" file="missing.stl"/>'
    mesh += '<hfield name="ground" file="missing.png" size="1 1 1 1"/>'
    looks = ARM.replace("<asset>", mesh).replace("<site", '<geom type="mesh" mesh="shell"/><site')
    torch.testing.assert_close(RigidChain(looks).inertia, RigidChain(ARM).inertia)
    box = '<geom type="box" size="0.05 0.04 0.03" pos="0.03 0 0"/>'
    solid = ARM.replace("<asset>", mesh).replace(box, '<geom type="mesh" mesh="shell"/>')
    chain, whole = RigidChain(solid), RigidChain(ARM)
    torch.testing.assert_close(chain.generic_inertia(), whole.generic_inertia())
    assert "tool" in chain.tree.problems[0]
    assert not whole.tree.problems


@pytest.mark.parametrize(
    ("old", "new", "effect"),
    [
        ('name="tilt"', 'name="tilt" stiffness="3"', "springs"),
        ('<body name="tool"', '<body name="tool" gravcomp="1"', "gravity compensation"),
        ("0.02 -0.5 0 0 0", "0.02 -0.5 1 0 0", "nonlinear equalities"),
        ("<equality>", '<equality><connect body1="finger" body2="cup" anchor="0 0 0"/>', "closed"),
        ("<default>", '<option gravity="0 -9.81 0"/><default>', "structure.gravity=[0,-9.81,0]"),
    ],
)
def test_effects_that_no_urdf_has_are_listed(old, new, effect, tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.replace(old, new, 1))
    stored = RigidChain(urdf_text(str(path)))  # without the file
    assert len(stored.tree.unread) == 1
    assert effect in stored.tree.unread[0]
    assert not RigidChain(ARM).tree.unread


def test_an_mjcf_that_mujoco_refuses_is_named(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.replace('axis="1 0 1"', 'axis="0 0 0"'))
    with pytest.raises(ValueError, match=f"{path}: .*axis") as error:
        RigidChain(str(path))
    assert "\n" not in str(error.value)
