"""PyBullet arms: against the contract, closed forms, and bad input."""

import copy
import hashlib
import pickle
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import torch

pybullet = pytest.importorskip("pybullet", reason="PyBullet is not installed (the panda extra)")
import pybullet_data  # noqa: E402

from pinn_dyn.evaluation.learned_terms import compare_terms  # noqa: E402
from pinn_dyn.systems import BulletArm  # noqa: E402
from pinn_dyn.testing import (  # noqa: E402  # noqa: E402
    Configurations,
    MechanicalSystemContract,
    assert_near,
    partial_derivatives,
)
from tests.support.arm_urdf import ARM, changed  # noqa: E402
from tests.support.bullet_arms import FINGERS, PANDA, states  # noqa: E402

pytestmark = pytest.mark.panda

# Skew axes, turned frames and products of inertia.
SPATIAL = """<robot name="spatial">
  <link name="base"/>
  <link name="one"><inertial><origin xyz="0.1 0.02 -0.3" rpy="0.3 -0.5 1.1"/><mass value="1.5"/>
    <inertia ixx="0.09" ixy="0.01" ixz="-0.015" iyy="0.07" iyz="0.02" izz="0.1"/></inertial></link>
  <link name="two"><inertial><origin xyz="0 0.1 -0.2" rpy="-0.7 0.2 0.4"/><mass value="0.8"/>
    <inertia ixx="0.05" ixy="-0.01" ixz="0.005" iyy="0.04" iyz="0.01" izz="0.06"/></inertial></link>
  <joint name="a" type="revolute"><parent link="base"/><child link="one"/>
    <origin rpy="0.4 0.1 -0.3"/><axis xyz="0 0 1"/><limit lower="-2" upper="2"/></joint>
  <joint name="b" type="revolute"><parent link="one"/><child link="two"/>
    <origin xyz="0.1 0.2 -0.5" rpy="-1.2 0.5 0.2"/><axis xyz="0.6 0 0.8"/>
    <limit lower="-2" upper="2"/></joint>
</robot>"""


def pendulum_terms(q, v, g=9.81):
    """M, C v and G of the double pendulum above, from its Lagrangian by hand."""
    m1, m2, c1, c2, l1, i1, i2 = 1.5, 0.8, 0.3, 0.2, 0.5, 0.05, 0.02
    k = m2 * l1 * c2
    m22 = m2 * c2**2 + i2
    m12 = m22 + k * np.cos(q[1])
    m11 = m1 * c1**2 + i1 + m2 * l1**2 + m22 + 2 * k * np.cos(q[1])
    coriolis = k * np.sin(q[1]) * np.array([-(2 * v[0] + v[1]) * v[1], v[0] ** 2])
    g2 = m2 * g * c2 * np.sin(q[0] + q[1])
    gravity = np.array([(m1 * c1 + m2 * l1) * g * np.sin(q[0]) + g2, g2])
    return np.array([[m11, m12], [m12, m22]]), coriolis, gravity


@pytest.fixture
def spatial(tmp_path):
    path = tmp_path / "spatial.urdf"
    path.write_text(SPATIAL)
    return str(path)


def panda_text():
    return Path(pybullet_data.getDataPath(), PANDA).read_text()


class TestPanda(MechanicalSystemContract):
    @pytest.fixture
    def system(self, panda):
        return panda

    @pytest.fixture
    def configurations(self, panda):
        q, v, a = states(panda, 8)
        return Configurations(*(torch.from_numpy(x) for x in (q, v, a, 10 * a)))

    def test_gradients_through_an_rk4_step_match_finite_differences(self, panda, configurations):
        """Bullet gives no derivatives of the dynamics: they are refused, not silently zero."""
        q, v, _, u = configurations
        with torch.enable_grad(), pytest.raises(RuntimeError, match="have no derivatives"):
            panda.forward_dynamics(q.clone().requires_grad_(), v, u)


# Against independent answers.


@pytest.mark.parametrize("gravity", [9.81, 0.0])
def test_double_pendulum_has_the_terms_of_its_closed_form(pendulum, gravity):
    arm = BulletArm(pendulum(), gravity=(0, 0, -gravity), damping=(0.3, 0.2))
    assert arm.joint_names == ["shoulder", "elbow"]
    q, v, a = states(arm)
    for k in range(len(q)):
        M, Cv, G = pendulum_terms(q[k], v[k], gravity)
        at = [torch.from_numpy(x[k]) for x in (q, v, a)]
        np.testing.assert_allclose(arm.mass_matrix(at[0]), M, rtol=0, atol=1e-12)
        np.testing.assert_allclose(arm.potential_force(at[0]), G, rtol=0, atol=1e-11)
        expected = M @ a[k] + Cv + G + np.array([0.3, 0.2]) * v[k]
        np.testing.assert_allclose(arm.inverse_dynamics(*at), expected, rtol=0, atol=1e-11)
        force = arm.coriolis_matrix(*at[:2]) @ at[1]
        np.testing.assert_allclose(force, Cv, rtol=0, atol=1e-11)


def rotation(axis, angle):
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def numbers(element, key):
    text = "0 0 0" if element is None else element.get(key, "0 0 0")
    return np.array([float(x) for x in text.split()])


def placed(R, r, origin):
    """The frame ``origin`` of a URDF, within the frame (R, r)."""
    roll, pitch, yaw = numbers(origin, "rpy")
    turn = rotation((0, 0, 1), yaw) @ rotation((0, 1, 0), pitch) @ rotation((1, 0, 0), roll)
    return R @ turn, r + R @ numbers(origin, "xyz")


def urdf_frames(text, q):
    """(R, r, [(axis, point), ...]) of every link of a URDF that names parents before children.

    Revolute joints take their angles from q in turn, prismatic ones stay at zero.
    """
    joints = ET.fromstring(text).findall("joint")
    frames = {joints[0].find("parent").get("link"): (np.eye(3), np.zeros(3), [])}
    angles = list(q)
    for joint in joints:
        R, r, axes = frames[joint.find("parent").get("link")]
        R, r = placed(R, r, joint.find("origin"))
        if joint.get("type") == "revolute":
            axis = numbers(joint.find("axis"), "xyz")
            axes = [*axes, (R @ axis, r)]
            R = R @ rotation(axis, angles.pop(0))
        frames[joint.find("child").get("link")] = (R, r, axes)
    assert not angles
    return frames


def jacobian_of(point, axes, size):
    linear, angular = np.zeros((2, 3, size))
    for index, (axis, origin) in enumerate(axes):
        linear[:, index], angular[:, index] = np.cross(axis, point - origin), axis
    return linear, angular


def urdf_mass_matrix(text, q):
    """sum m J^T J + Jw^T I Jw over all links of a URDF but its base."""
    links = {link.get("name"): link.find("inertial") for link in ET.fromstring(text).iter("link")}
    mass_matrix = np.zeros((len(q), len(q)))
    for name, (R, r, axes) in urdf_frames(text, q).items():
        if not axes:
            continue
        Rc, centre = placed(R, r, links[name].find("origin"))
        xx, xy, xz, yy, yz, zz = (
            float(links[name].find("inertia").get(f"i{key}"))
            for key in ("xx", "xy", "xz", "yy", "yz", "zz")
        )
        inertia = Rc @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ Rc.T
        linear, angular = jacobian_of(centre, axes, len(q))
        mass = float(links[name].find("mass").get("value"))
        mass_matrix += mass * linear.T @ linear + angular.T @ inertia @ angular
    return mass_matrix


def test_panda_has_the_mass_matrix_of_its_urdf_with_the_fingers_locked(panda):
    assert panda.num_coordinates == 7
    q = states(panda)[0]
    M = panda.mass_matrix(torch.from_numpy(q))
    text = panda_text()
    for k in range(len(q)):
        np.testing.assert_allclose(M[k], urdf_mass_matrix(text, q[k]), rtol=0, atol=1e-9)


def test_products_of_inertia_and_turned_frames_count_in_full(spatial):
    arm = BulletArm(spatial, damping=0)
    q, v, _ = states(arm)
    M = arm.mass_matrix(torch.from_numpy(q))
    for k in range(len(q)):
        np.testing.assert_allclose(M[k], urdf_mass_matrix(SPATIAL, q[k]), rtol=0, atol=1e-9)
    # Bullet's stepping uses another algorithm than its M: the two have to agree as well.
    q, v, u = arm.simulate(q[0], v[0], lambda k, q, v: np.array([0.3, -0.2]), steps=20, step=1e-3)
    a = arm.forward_dynamics(*(torch.from_numpy(x[:-1]) for x in (q, v, u))).numpy()
    np.testing.assert_allclose(v[1:], v[:-1] + 1e-3 * a, rtol=0, atol=1e-8)


def test_inertia_from_collision_shapes_differs_in_inertia_alone(panda):
    arm = BulletArm(PANDA, locked_joints=FINGERS, inertia="collision")
    q = torch.from_numpy(states(panda)[0])
    assert_near(arm.potential_energy(q), panda.potential_energy(q), 1e-12)
    assert arm.describe()["urdf"] != panda.describe()["urdf"]  # the meshes are part of it
    smallest = [torch.linalg.eigvalsh(x.mass_matrix(q))[:, 0] for x in (arm, panda)]
    assert (smallest[0] > 0).all()
    assert (smallest[0] < 0.1 * smallest[1]).all()


@pytest.mark.parametrize("tip", [None, "panda_link5", "panda_hand"])
def test_tip_of_the_panda_is_where_its_urdf_puts_it(tip):
    arm = BulletArm(PANDA, locked_joints=FINGERS, tip=tip)
    check_tip(arm, panda_text(), tip or "panda_grasptarget")


@pytest.mark.parametrize("tip", [None, "one"])
def test_tip_with_turned_and_shifted_inertial_frames(spatial, tip):
    check_tip(BulletArm(spatial, tip=tip), SPATIAL, tip or "two")


def check_tip(arm, text, link):
    q = states(arm)[0]
    position, jacobian = (f(torch.from_numpy(q)) for f in (arm.tip_position, arm.tip_jacobian))
    for k in range(len(q)):
        _, r, axes = urdf_frames(text, q[k])[link]
        np.testing.assert_allclose(position[k], r, rtol=0, atol=1e-12)
        expected = np.concatenate(jacobian_of(r, axes, len(q[k])))
        np.testing.assert_allclose(jacobian[k], expected, rtol=0, atol=1e-12)
    slopes = partial_derivatives(arm.tip_position, torch.from_numpy(q))
    assert_near(jacobian[:, :3], slopes, 1e-10, scale=1)
    x = torch.from_numpy(q[0]).requires_grad_()
    (gradient,) = torch.autograd.grad(arm.tip_position(x)[1], x)
    assert torch.equal(gradient, jacobian[0, 1])


def test_default_tip_is_the_frame_behind_the_last_joint(pendulum):
    arm = BulletArm(pendulum(('child link="tool"/', 'child link="tool"/><origin xyz="0 0 -0.4"/')))
    q = torch.tensor([0.3, 0.5], dtype=torch.float64)
    a, b = 0.3, 0.8
    expected = [-0.5 * np.sin(a) - 0.4 * np.sin(b), 0, -0.5 * np.cos(a) - 0.4 * np.cos(b)]
    np.testing.assert_allclose(arm.tip_position(q), expected, rtol=0, atol=1e-12)
    assert arm.tip_position(q.float()).dtype == torch.float32


# Plants that differ from their model.


@pytest.mark.parametrize("inertia", ["file", "collision"])
def test_mass_scale_multiplies_mass_matrix_and_gravity(inertia):
    options = {"locked_joints": FINGERS, "inertia": inertia}
    arm, heavy = BulletArm(PANDA, **options), BulletArm(PANDA, mass_scale=1.2, **options)
    q = torch.from_numpy(states(arm)[0])
    assert_near(heavy.mass_matrix(q), 1.2 * arm.mass_matrix(q), 1e-14)
    assert_near(heavy.potential_force(q), 1.2 * arm.potential_force(q), 1e-14)
    assert_near(heavy.potential_energy(q), 1.2 * arm.potential_energy(q), 1e-14)


@pytest.mark.parametrize("inertia", ["file", "collision"])
@pytest.mark.parametrize("tip", [None, "panda_link5"])
def test_payload_is_a_point_mass_at_the_tip(inertia, tip):
    options = {"locked_joints": FINGERS, "inertia": inertia, "tip": tip, "gravity": (1, -2, -9.81)}
    arm, loaded = BulletArm(PANDA, **options), BulletArm(PANDA, payload=2.3, **options)
    q = torch.from_numpy(states(arm)[0])
    J, g = arm.tip_jacobian(q)[:, :3], torch.tensor(arm.gravity, dtype=torch.float64)
    added = loaded.mass_matrix(q) - arm.mass_matrix(q)
    torch.testing.assert_close(added, 2.3 * J.mT @ J, rtol=0, atol=1e-13)
    added = loaded.potential_force(q) - arm.potential_force(q)
    torch.testing.assert_close(added, -2.3 * J.mT @ g, rtol=0, atol=1e-12)
    added = loaded.potential_energy(q) - arm.potential_energy(q)
    torch.testing.assert_close(added, -2.3 * arm.tip_position(q) @ g, rtol=0, atol=1e-12)
    assert torch.equal(loaded.tip_position(q), arm.tip_position(q))


def test_describe_names_what_changes_the_motion_and_nothing_else(panda):
    described = panda.describe()
    assert list(described) == ["urdf", "joints", "inertia", "damping", "gravity", "pybullet"]
    assert described["urdf"] == hashlib.sha256(panda_text().encode()).hexdigest()
    options = {"locked_joints": FINGERS, "damping": 0.5}
    assert BulletArm(PANDA, tip="panda_hand", **options).describe() == described
    changed = BulletArm(PANDA, mass_scale=0.9, payload=1.0, **options).describe()
    extra = {"mass_scale": 0.9, "payload": 1.0, "tip": "panda_grasptarget"}
    assert changed == {**described, **extra}


# As an object among others.


def test_copies_and_pickles_give_the_same_numbers(panda):
    q = torch.from_numpy(states(panda)[0])
    for twin in (copy.deepcopy(panda), pickle.loads(pickle.dumps(panda))):
        assert torch.equal(twin.mass_matrix(q), panda.mass_matrix(q))
        assert torch.equal(twin.damping_matrix(q), panda.damping_matrix(q))


def test_two_arms_in_one_process_keep_their_own_gravity(panda):
    heavy = BulletArm(PANDA, locked_joints=FINGERS, gravity=(0, 0, -19.62))
    q = torch.from_numpy(states(panda)[0])
    assert_near(heavy.potential_force(q), 2 * panda.potential_force(q), 1e-12)
    assert_near(heavy.potential_energy(q), 2 * panda.potential_energy(q), 1e-12)


def test_terms_are_compared_with_the_arm_as_the_truth(panda):
    stiff = BulletArm(PANDA, locked_joints=FINGERS, damping=1.0)
    comparison = compare_terms(stiff, panda, torch.from_numpy(states(panda, 2)[0]).float())
    errors = comparison.to_frame().set_index("term").relative_error_identity
    assert errors["D"].to_list() == pytest.approx([1, 1])
    assert errors.drop("D").abs().max() < 1e-12


# Bad input.


@pytest.mark.parametrize(
    ("changes", "arguments", "message"),
    [
        ([], {"damping": [0.1, 0.2, 0.3]}, r"damping has 3 entries, but .*pendulum.urdf has 2"),
        ([], {"damping": -0.1}, r"damping is -0.1, expected finite numbers of at least 0"),
        ([], {"locked_joints": ["wrist"]}, r"no joint 'wrist' to lock: .* shoulder, elbow, flange"),
        ([], {"locked_joints": ["shoulder", "elbow"]}, r"no revolute joint that is free"),
        ([], {"inertia": "guess"}, r"inertia is 'guess', expected 'file' or 'collision'"),
        ([], {"inertia": "collision"}, r"link 'upper' moves and has no <collision>"),
        ([], {"gravity": [0, -9.81]}, r"gravity is \[0, -9.81\], expected 3"),
        ([], {"tip": "hand"}, r"tip is 'hand', expected a link behind a joint: upper, lower, tool"),
        ([], {"tip": "base"}, r"tip is 'base', expected a link behind a joint: upper, lower, tool"),
        ([], {"mass_scale": 0}, r"mass_scale is 0, expected a positive finite number"),
        ([], {"payload": -1.0}, r"payload is -1.0, expected a finite number of at least 0 in kg"),
        ([], {"payload": float("nan")}, r"payload is nan, expected a finite number"),
        ([('"continuous"', '"floating"')], {}, r"joint 'elbow' is of type 'floating', but an arm"),
        ([('"continuous"', '"prismatic"')], {}, r"'elbow' is of type 'prismatic'.*locked_joints"),
        ([('value="0.8"', 'value="0"')], {}, r"link 'lower' moves with joint 'elbow' and has no m"),
        ([('value="0.8"', 'value="-1"')], {}, r"link 'lower' has mass -1 kg"),
        ([('value="0.8"', 'value="heavy"')], {}, r"'lower' has <mass value='heavy'>, expected a"),
        ([("inertia ", "nothing ")], {}, r"link 'upper' moves and has no <inertia>"),
        ([('iyy="0.02"', 'iyy="0.002"')], {}, r"link 'lower' has the principal moments"),
        ([('lower="-0.1"', 'lower="0.1"')], {}, r"joint 'shoulder' has limits lower = 0.1 and upp"),
        ([('child link="lower"', 'child link="low"')], {}, r"joint 'elbow' has the child 'low'"),
        ([("</robot>", "")], {}, r"pendulum.urdf is not valid XML for a URDF"),
        ([("robot", "sdf")], {}, r"holds <sdf> with 3 joints, expected <robot>"),
    ],
)
def test_bad_input_is_refused_with_what_to_do(pendulum, changes, arguments, message):
    with pytest.raises(ValueError, match=message):
        BulletArm(pendulum(*changes), **arguments)


def test_a_missing_urdf_is_named_with_a_close_one():
    with pytest.raises(FileNotFoundError, match=r"'franka_panda/pnda.urdf' not found.*panda.urdf"):
        BulletArm("franka_panda/pnda.urdf")


def test_a_missing_mesh_is_named(pendulum):
    shape = '<collision><geometry><mesh filename="package://arm.obj"/></geometry></collision>'
    path = pendulum(("</inertial>", f"</inertial>{shape}"))
    with pytest.raises(FileNotFoundError, match=r"mesh 'package://arm.obj' not found"):
        BulletArm(path, inertia="collision")
    assert BulletArm(path, inertia="file").num_coordinates == 2


def test_without_pybullet_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ImportError, match=r"pip install 'pinn_dyn\[panda\]'.*3\.10 and 3\.11"):
        BulletArm(PANDA)


def test_half_an_inertial_is_the_mass_or_the_frame_that_it_says(tmp_path):
    """Bullet itself refuses the file, in words on the terminal only."""
    path = tmp_path / "arm.urdf"
    path.write_text(changed(('<link name="base"/>', '<link name="base"><inertial/></link>')))
    whole = tmp_path / "whole.urdf"
    whole.write_text(ARM)
    q = torch.tensor([0.3, 0.4], dtype=torch.float64)
    torch.testing.assert_close(
        BulletArm(str(path)).mass_matrix(q), BulletArm(str(whole)).mass_matrix(q)
    )
