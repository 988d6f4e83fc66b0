"""What motions tell of rigid bodies, against closed forms of small robots and printed counts."""

import numpy as np
import pandas as pd
import pytest
import torch

from pinn_dyn.data.logs import LogSource
from pinn_dyn.identification.rigid_excitation import base_columns, base_parameters, rigid_excitation
from pinn_dyn.log_check.check import check
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.systems import RigidChain
from tests.support.delayed_robots import log, sines
from tests.support.rigid_chains import TREE, joint, link, robot

PENDULUM = robot(
    link("base"), link("rod"), joint("hinge", "continuous", "base", "rod", "0 0 0", "0 0 0")
)
TWO_RODS = robot(
    link("base"),
    link("upper"),
    link("lower"),
    joint("shoulder", "continuous", "base", "upper", "0 0 0", "0 0 0"),
    joint("elbow", "continuous", "upper", "lower", "0 0 -0.5", "0 0 0"),
)


def motion(size, *, seconds=20.0, rate=200.0, still=(), seed=0, highest=1.0):
    """A sum of sines in each joint, which rests where it is told to."""
    signal = sines(np.random.default_rng(seed), size, size=0.8, highest=highest)
    t = torch.arange(round(seconds * rate), dtype=torch.float64) / rate
    moves = torch.tensor([k not in still for k in range(size)])
    q, v = (torch.from_numpy(signal(t.numpy(), order)) * moves for order in (0, 1))
    return Trajectory(q, v, Signal(t, torch.zeros_like(q)))


def regressor_at_random(chain):
    q, v, a = torch.rand(3, 300, chain.num_coordinates, dtype=torch.float64) * 3 - 1.5
    return chain.regressor(q, v, a).flatten(0, 1).numpy()


def test_a_link_carries_the_mass_of_the_next_one_as_a_point_at_its_joint():
    """Two rods in a plane: l below the shoulder, m2 adds to m cz and Iyy of the first as m2 l."""
    regressor = regressor_at_random(RigidChain(TWO_RODS))
    columns = base_parameters(regressor)
    # Of ten each: m cx, m cz and Iyy of both.
    assert columns.tolist() == [1, 3, 6, 11, 13, 16]
    expected = np.zeros((6, 20))
    expected[np.arange(6), columns] = 1
    expected[1, 10] = -0.5
    expected[2, 10] = 0.25
    np.testing.assert_allclose(regressor, regressor[:, columns] @ expected, atol=1e-9)


@pytest.mark.parametrize("angle", ["1.5707963267948966", "1.57"])
def test_rounded_angles_of_a_urdf_add_no_base_parameter(angle):
    """Armatures 1 and 2 are grouped with links where axes are orthogonal (Gautier, Khalil 1990)."""
    parts = [link("base"), *(link(f"body{k}") for k in range(3))]
    ends = zip(("base", "body0", "body1"), ("body0", "body1", "body2"), strict=True)
    for k, (before, behind) in enumerate(ends):
        rpy = "0 0 0" if k == 0 else f"{'-' if k % 2 else ''}{angle} 0 0"
        parts.append(joint(f"joint{k}", "continuous", before, behind, "0 0 0", rpy, axis="0 0 1"))
    assert len(base_columns(RigidChain(robot(*parts)))) == (1 + 7 + 7) + 3 * 3 + 1


def test_the_panda_has_43_base_parameters():
    """As printed by Gaz et al. 2019, "Dynamic identification of the Franka Emika Panda robot"."""
    pytest.importorskip("pybullet_data")
    fingers = ["panda_finger_joint1", "panda_finger_joint2"]
    chain = RigidChain("franka_panda/panda.urdf", locked_joints=fingers)
    regressor = regressor_at_random(chain)
    columns = base_parameters(regressor)
    assert len(columns) == 43
    grouping = np.linalg.lstsq(regressor[:, columns], regressor, rcond=None)[0]
    np.testing.assert_allclose(regressor[:, columns] @ grouping, regressor, atol=1e-6)


def test_the_condition_number_of_a_pendulum_is_that_of_its_six_columns():
    run = motion(1)
    excitation = rigid_excitation(RigidChain(PENDULUM), [run], cutoff=20.0)
    q, v = run.q[:, 0].numpy(), run.v[:, 0].numpy()
    a, moves = np.gradient(v, run.t.numpy()), np.abs(v) > 0.05 * v.std()
    columns = [a, np.sin(q), np.cos(q), v, np.sign(v), np.ones_like(q)]
    columns = np.stack([x[moves] / np.linalg.norm(x[moves]) for x in columns], axis=1)
    assert excitation.count == 6
    assert excitation.condition == pytest.approx(np.linalg.cond(columns), rel=0.02)
    assert excitation.undetermined == "none"


def test_motions_of_all_joints_leave_nothing_open():
    chain = RigidChain(TREE, locked_joints=["wrist"])
    excitation = rigid_excitation(chain, [motion(4, seconds=60.0)], cutoff=10.0)
    assert excitation.condition < 100
    assert excitation.open_joints == []


def test_constants_count_at_the_joints_that_move_their_bodies():
    """Whatever the order of the coordinates is."""
    names, run = ["fork", "turn", "bend", "slide"], motion(4)
    chains = RigidChain(TREE, locked_joints=["wrist"]), RigidChain(TREE, joints=names)
    usual, other = (
        rigid_excitation(chain, [run], cutoff=10.0).joints.set_index("joint")["base parameters"]
        for chain in chains
    )
    assert other[usual.index].tolist() == usual.tolist()


def test_a_joint_that_rests_is_named_despite_noise():
    chain = RigidChain(TREE, locked_joints=["wrist"])
    run = motion(4, seconds=60.0, still=[3])
    generator = torch.Generator().manual_seed(0)
    q, v = (x + 1e-5 * torch.randn(x.shape, generator=generator) for x in (run.q, run.v))
    still = [False, False, False, True]
    excitation = rigid_excitation(chain, [Trajectory(q, v, run.input)], cutoff=10.0, still=still)
    name = chain.joint_names[3]
    assert name in excitation.open_joints
    # Only the body before the joint that rests has constants in common with its body.
    assert not {"slide", "bend"} & set(excitation.open_joints)
    for label in ("viscous friction", "dry friction", "offset"):
        assert f"{label} of {name}" in excitation.undetermined
    assert excitation.condition > 1e6


def test_one_slow_sine_does_not_tell_the_constants_apart():
    """A pendulum with one sine of small amplitude: sin q follows a, and cos q follows 1."""
    t = torch.arange(8000, dtype=torch.float64)[:, None] / 200
    q, v = 0.02 * torch.sin(2 * t), 0.04 * torch.cos(2 * t)
    excitation = rigid_excitation(
        RigidChain(PENDULUM), [Trajectory(q, v, Signal(t[:, 0], 0 * q))], cutoff=20.0
    )
    assert excitation.undetermined.count(";") == 1
    assert excitation.open_joints == ["hinge"]
    assert excitation.condition > 1000


@pytest.mark.parametrize("follows", [False, True])
def test_the_check_of_a_log_names_a_joint_that_is_not_excited(follows):
    """A log of the two-link arm, whose second joint follows the first or does not."""
    item = log("arm", 0, 0.0)
    second = np.full(len(item), 0.3) if follows else item.q[:, 1]
    table = {"t": item.t, "q1": item.q[:, 0], "q2": second, "u1": item.u[:, 0], "u2": item.u[:, 1]}
    source = LogSource(
        name="arm",
        files=pd.DataFrame(table),
        time=dict(columns="t", unit="s"),
        q=dict(columns=["q1", "q2"], unit="rad"),
        u=dict(columns=["u1", "u2"], unit="Nm"),
        validation=dict(seconds=1.0, piece=1.0),
        test=dict(seconds=2.0, piece=1.0),
    )
    result = check(source, structure=RigidChain(TWO_RODS))
    # Six of the bodies, the elbow's armature, three frictions and offsets for each joint.
    assert result.rigid.count == 13
    assert ("elbow" in result.rigid.open_joints) == follows
    assert (result.rigid.condition > 100) == follows
    assert ("dry friction of elbow" in str(result)) == follows
    assert any("do not determine constants of" in text for text in result.warnings) == follows
