"""Rigid chains from a URDF against Pinocchio, Bullet and each other."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from pinn_dyn.systems import RigidChain
from pinn_dyn.systems.inertia import inertial_parameters, pseudo_inertia
from pinn_dyn.testing import MechanicalSystemContract
from tests.support.contracts import one_case
from tests.support.rigid_chains import TREE, joint, link, robot

FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
STATES = 100


def urdf_file(name):
    """A URDF that ships with PyBullet, or that of the UR10e among the logs."""
    if name == "ur10e":
        path = Path(os.environ.get("PINN_DYN_LOGS", "logs")) / "ur10e" / "ur10e.urdf"
        if not path.is_file():
            pytest.skip(f"no {path}: the folder of the logs is PINN_DYN_LOGS")
        return path
    package = pytest.importorskip("pybullet_data", reason="the panda extra is not installed")
    return Path(package.getDataPath()) / name


def states(size, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [4 * torch.rand(STATES, size, generator=generator).double() - 2 for _ in range(3)]


def assert_same(actual, expected):
    expected = torch.as_tensor(np.array(expected))
    assert (actual - expected).abs().max() <= 1e-10 * expected.abs().max()


class PinocchioRobot:
    """The same robot in Pinocchio; its continuous joints are given by cosine and sine."""

    def __init__(self, text, locked):
        self.pin = pytest.importorskip("pinocchio", reason="the dev extra is not installed")
        model = self.pin.buildModelFromXML(text)
        if locked:
            ids = [model.getJointId(name) for name in locked]
            model = self.pin.buildReducedModel(model, ids, self.pin.neutral(model))
        self.model, self.data = model, model.createData()
        self.names = list(model.names)[1:]

    def __call__(self, function, q, *others):
        """Results of one of Pinocchio's functions at each state."""
        results = []
        for row, *rest in zip(q.numpy(), *(x.numpy() for x in others), strict=True):
            values = []
            for angle, item in zip(row, list(self.model.joints)[1:], strict=True):
                values += [angle] if item.nq == 1 else [np.cos(angle), np.sin(angle)]
            results.append(function(self.model, self.data, np.array(values), *rest).copy())
        return np.stack(results)


@pytest.mark.parametrize(
    ("name", "locked"),
    [
        ("franka_panda/panda.urdf", FINGERS),
        ("kuka_iiwa/model.urdf", ()),
        ("ur10e", ()),
        ("tree", ("wrist",)),
    ],
)
def test_a_chain_equals_pinocchio(name, locked):
    text = TREE if name == "tree" else urdf_file(name).read_text()
    chain, other = RigidChain(text, locked_joints=locked), PinocchioRobot(text, locked)
    # Pinocchio sorts the branches of a tree by name.
    order = [other.names.index(joint) for joint in chain.joint_names]
    back = [chain.joint_names.index(joint) for joint in other.names]
    q, v, a = states(chain.num_coordinates)
    pin = other.pin
    theirs = [x[:, back] for x in (q, v, a)]
    mass = other(pin.crba, theirs[0])
    mass = np.triu(mass) + np.triu(mass, 1).transpose(0, 2, 1)
    assert_same(chain.mass_matrix(q), mass[:, order][:, :, order])
    force = other(pin.rnea, *theirs)[:, order]
    assert_same(chain.inverse_dynamics(q, v, a), force)
    assert_same(chain.potential_force(q), other(pin.computeGeneralizedGravity, theirs[0])[:, order])
    assert_same(chain.forward_dynamics(q, v, a), other(pin.aba, *theirs)[:, order])
    regressor = other(pin.computeJointTorqueRegressor, *theirs)[:, order]
    regressor = regressor.reshape(STATES, len(order), -1, 10)[:, :, order].reshape(
        STATES, len(order), -1
    )
    assert_same(chain.regressor(q, v, a), regressor)
    assert_same(chain.regressor(q, v, a) @ chain.parameters_of().flatten(), force)
    for which, ours in enumerate(chain.force_slopes(q, v, a)):
        slope = other(lambda *at, k=which: pin.computeRNEADerivatives(*at)[k], *theirs)
        assert_same(ours, slope[:, order][:, :, order])


@one_case
class TestRigidChainContract(MechanicalSystemContract):
    @pytest.fixture
    def system(self):
        return RigidChain(TREE, locked_joints=["wrist"], damping=[0.1, 0.2, 0.0, 0.4])


def test_derivatives_by_autograd_and_a_compilable_graph():
    chain = RigidChain(TREE, locked_joints=["wrist"])
    q, v, u = (x[:3].requires_grad_() for x in states(4))
    assert torch.autograd.gradcheck(chain.forward_dynamics, (q, v, u))
    torch.export.export(_Dynamics(chain), (q.detach(), v.detach(), u.detach()), strict=False)


class _Dynamics(torch.nn.Module):
    def __init__(self, chain):
        super().__init__()
        self.chain = chain

    def forward(self, q, v, u):
        return self.chain.forward_dynamics(q, v, u)


def test_parameters_and_pseudo_inertia_are_each_others_inverse():
    parameters = torch.randn(5, 10, dtype=torch.float64)
    assert torch.allclose(inertial_parameters(pseudo_inertia(parameters)), parameters)


def test_a_payload_is_not_scaled_with_the_links():
    settings = {"locked_joints": ["wrist"], "tip": "hand"}
    chain, other = (RigidChain(TREE, **settings, payload=x) for x in (0.0, 0.8))
    q, energy = states(4)[0], 0.8 * 9.81 * chain.tip_position(states(4)[0])[:, 2]
    assert_same(other.potential_energy(q) - chain.potential_energy(q), energy)
    plain = chain.inertia[:, 3, 3]
    loaded = RigidChain(TREE, **settings, mass_scale=1.5, payload=0.8).inertia[:, 3, 3]
    added = torch.where(plain == plain[2], 0.8, 0.0).double()  # the wrist is locked to the elbow
    torch.testing.assert_close(loaded, 1.5 * plain + added)


def test_a_generic_body_is_a_cylinder_to_the_farthest_next_joint():
    """The next joints are 0.36 m and 0.22 m from the shoulder."""
    near = joint("near", "revolute", "shoulder", "branch", xyz="0 0.2 0.1")
    far = joint("far", "revolute", "shoulder", "elbow", xyz="0 0 0.36")
    names = ("base", "shoulder", "elbow", "branch")
    turn = joint("turn", "revolute", "base", "shoulder")
    body = RigidChain(robot(*map(link, names), turn, near, far)).generic_inertia()[0]
    length, radius = 0.36, 0.06  # the only rod with a next joint has the mean length
    mass = 1000 * np.pi * radius**2 * length
    across, along = mass * (radius**2 / 4 + length**2 / 3), mass * radius**2 / 2
    expected = [mass, 0, 0, mass * length / 2, across, 0, across, 0, 0, along]
    np.testing.assert_allclose(inertial_parameters(body), expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("axis", ["1 0 0", "0 1 0", "0 0 1"])
def test_a_last_generic_body_does_not_lie_on_the_axis(axis):
    swing = joint("swing", "revolute", "base", "pole", xyz="0 0 0", rpy="0 0 0", axis=axis)
    chain = RigidChain(robot(link("base"), link("pole"), swing))
    body = chain.generic_inertia()
    centre = body[0, :3, 3] / body[0, 3, 3]
    along = torch.tensor([float(x) for x in axis.split()]).double()
    assert float(torch.linalg.cross(centre, along).norm()) > 0.03  # of a rod of 0.1 m
    if axis != "0 0 1":  # hangs down at q = 0
        force = chain.rigid_force(
            0.5 * torch.ones(1, 1).double(), *torch.zeros(2, 1, 1).double(), body
        )
        assert float(force) > 0


def test_coordinates_may_have_another_order():
    """A permutation P of the coordinates: P^T M P, and all terms of the contract alike."""
    names = ["fork", "turn", "bend", "slide"]
    chain, usual = (RigidChain(TREE, locked_joints=["wrist"], joints=x) for x in (names, None))
    order = [usual.joint_names.index(name) for name in names]
    q, v, a = states(4)
    theirs = [torch.empty_like(x).index_copy_(-1, torch.tensor(order), x) for x in (q, v, a)]
    assert_same(chain.mass_matrix(q), usual.mass_matrix(theirs[0])[:, order][:, :, order])
    assert_same(chain.inverse_dynamics(q, v, a), usual.inverse_dynamics(*theirs)[:, order])
    assert_same(chain.potential_energy(q), usual.potential_energy(theirs[0]))
    for ours, other in zip(chain.force_slopes(q, v, a), usual.force_slopes(*theirs), strict=True):
        assert_same(ours, other[:, order][:, :, order])
    assert_same(chain.tip_position(q), usual.tip_position(theirs[0]))
    assert chain.turning == [True, True, True, False]
    assert chain.limits.tolist() == usual.limits[order].tolist()


def test_joints_that_are_not_named_are_locked():
    chain = RigidChain(TREE, joints=["turn", "bend"])
    other = RigidChain(TREE, locked_joints=["slide", "fork", "wrist"])
    q, v, a = states(2)
    assert_same(chain.rigid_force(q, v, a), other.rigid_force(q, v, a))
    with pytest.raises(
        ValueError, match=r"joints has \['elbow'\], expected different names out of \['turn', "
    ):
        RigidChain(TREE, joints=["turn", "elbow"])


def test_a_joint_is_locked_at_its_angle():
    chain = RigidChain(TREE, locked_joints={"wrist": 0.0, "slide": 0.2, "fork": -1.0, "bend": 0.7})
    whole = RigidChain(TREE)
    q, v, a = states(1)
    full = [torch.zeros(STATES, 5).double() for _ in range(3)]
    for x, values in zip(full, (q, v, a), strict=True):
        x[:, 0] = values[:, 0]
    for name, angle in chain.locked_joints.items():
        full[0][:, whole.joint_names.index(name)] = angle
    assert_same(chain.rigid_force(q, v, a), whole.rigid_force(*full)[:, :1])


COUPLED = TREE.replace(
    '<joint name="bend" type="continuous">',
    '<joint name="bend" type="continuous"><mimic joint="turn" multiplier="-1.5" offset="0.4"/>',
).replace(
    '<joint name="fork" type="revolute">',
    '<joint name="fork" type="revolute"><mimic joint="bend" multiplier="0.5" offset="-0.1"/>',
)


def test_mimic_joints_move_as_in_pinocchio():
    """M, C v + G, G, V and slopes of the free tree, reduced by q_all = J q + offset."""
    chain, other = RigidChain(COUPLED), PinocchioRobot(TREE, ())
    assert chain.joint_names == ["turn", "slide", "wrist"]
    jacobian = torch.zeros(len(other.names), 3).double()
    offset = torch.zeros(len(other.names)).double()
    for row, column, factor, shift in (
        *(("turn", 0, 1, 0), ("bend", 0, -1.5, 0.4), ("fork", 0, -0.75, 0.1)),
        *(("slide", 1, 1, 0), ("wrist", 2, 1, 0)),
    ):
        k = other.names.index(row)
        jacobian[k, column], offset[k] = factor, shift
    q, v, a = states(3)
    theirs = [q @ jacobian.T + offset, v @ jacobian.T, a @ jacobian.T]
    pin = other.pin
    mass = other(pin.crba, theirs[0])
    mass = torch.from_numpy(np.triu(mass) + np.triu(mass, 1).transpose(0, 2, 1))
    assert_same(chain.mass_matrix(q), jacobian.T @ mass @ jacobian)
    force = torch.from_numpy(other(pin.rnea, *theirs)) @ jacobian
    assert_same(chain.inverse_dynamics(q, v, a), force)
    assert_same(chain.regressor(q, v, a) @ chain.parameters_of().flatten(), force)
    gravity = torch.from_numpy(other(pin.computeGeneralizedGravity, theirs[0]))
    assert_same(chain.potential_force(q), gravity @ jacobian)
    for which, ours in enumerate(chain.force_slopes(q, v, a)):
        slope = other(lambda *at, k=which: pin.computeRNEADerivatives(*at)[k], *theirs)
        assert_same(ours, jacobian.T @ torch.from_numpy(slope) @ jacobian)


def test_mimic_joints_are_held_with_a_joint_that_is_locked():
    chain = RigidChain(COUPLED, locked_joints={"turn": 0.2})
    other = RigidChain(TREE, locked_joints={"turn": 0.2, "bend": 0.1, "fork": -0.05})
    assert chain.joint_names == other.joint_names
    torch.testing.assert_close(chain.inertia, other.inertia)
    torch.testing.assert_close(chain.tree.placements, other.tree.placements)


@one_case
class TestCoupledChainContract(MechanicalSystemContract):
    @pytest.fixture
    def system(self):
        return RigidChain(COUPLED, joints=["wrist", "turn", "slide"], damping=[0.1, 0.2, 0.0])
