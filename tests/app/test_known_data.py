"""Known mechanics are refused on data of other joints, and on currents without gains."""

import logging

import pytest
import torch

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.known_data import check_known, check_structure
from pinn_dyn.data import LogSource
from pinn_dyn.models import KnownMechanics, Statistics
from pinn_dyn.systems import RigidChain
from tests.support.rigid_chains import joint, link, robot

PART = {"seconds": 1.0, "piece": 1.0}
NAMES = ("shoulder_pan_joint", "elbow_joint", "joint1")


def urdf(names=NAMES):
    links = [link("base"), *(link(f"body{k}", 1.0) for k in range(len(names)))]
    chain = ["base", *(f"body{k}" for k in range(len(names)))]
    ends = zip(names, chain, chain[1:], strict=False)
    return robot(*links, *(joint(name, "continuous", a, b) for name, a, b in ends))


def log_of(q, u=None, v=None, unit="Nm", q_unit="rad"):
    return LogSource(
        name="arm",
        root=".",
        files="*.csv",
        time=dict(columns="t", unit="s"),
        q=dict(columns=q, unit=q_unit),
        v=None if v is None else dict(columns=v, unit="rad/s"),
        u=dict(columns=u or [f"u{k}" for k in range(len(q))], unit=unit),
        validation=PART,
        test=PART,
    )


def chain(names=NAMES):
    return RigidChain(urdf=urdf(names))


def check(source, names=NAMES):
    check_structure("model.structure", chain(names), source)


def test_a_column_that_names_two_joints_counts_by_its_order():
    check(log_of(["q1", "q2", "hip_leg"]), names=("arm", "hip", "leg"))


@pytest.mark.parametrize("signal", ["q", "v", "u"])
def test_a_crossed_order_is_refused_with_the_right_one(signal):
    crossed = {"q": ["q1", "q2", "q3"], signal: ["elbow_pos", "ShoulderPan.pos", "joint1_pos"]}
    message = (
        rf"dataset.{signal}.columns has the order elbow_pos, ShoulderPan.pos, joint1_pos, and "
        r"model.structure has the joints shoulder_pan_joint, elbow_joint, joint1: expected "
        rf"dataset.{signal}.columns=\[ShoulderPan.pos,elbow_pos,joint1_pos\]"
    )
    with pytest.raises(ConfigError, match=message):
        check(log_of(**crossed))


@pytest.mark.parametrize(
    "columns",
    [["shoulder_pan", "elbow", "joint1"], ["q1", "q2", "q3"], ["q1", "elbow_joint", "x"]],
)
def test_the_order_of_the_joints_passes(columns):
    check(log_of(columns))


def test_a_longer_name_is_not_taken_for_a_shorter_one():
    names = ("joint1", "joint10", "joint100")
    check(log_of(["joint1_q", "joint10_q", "joint100_q"]), names)
    with pytest.raises(ConfigError, match=r"\[joint1_q,joint10_q,joint100_q\]"):
        check(log_of(["joint10_q", "joint1_q", "joint100_q"]), names)


def test_columns_that_name_no_joint_are_logged_with_their_joints(caplog):
    with caplog.at_level(logging.INFO):
        check(log_of(["q1", "q2", "q3"], ["u_shoulder_pan", "u_elbow", "u_joint1"]))
    expected = "by their order: q1 -> shoulder_pan_joint; q2 -> elbow_joint; q3 -> joint1"
    assert expected in caplog.text  # u names its joints


def test_a_joint_that_turns_is_not_measured_in_metres():
    text = urdf(["slider", "elbow"]).replace(
        '"slider" type="continuous"', '"slider" type="prismatic"'
    )
    structure = RigidChain(urdf=text)
    check_structure("structure", structure, log_of(["q1", "q2"], q_unit=["mm", "deg"]))
    check_structure("structure", structure, log_of(["q1", "q2"], q_unit="1"))
    with pytest.raises(ConfigError, match=r"q1 is in rad, expected m for the joint slider"):
        check_structure("structure", structure, log_of(["q1", "q2"], q_unit=["deg", "mm"]))


def known(**settings):
    ones, increments = torch.ones(3).double(), torch.full((1, 6), 0.01).double()
    values = (0 * ones, ones, -ones, ones, ones, ones, 0 * ones, ones, increments, increments)
    return KnownMechanics(Statistics(*values, 0.01), structure=chain(), **settings)


@pytest.mark.parametrize("unit", ["A", "V"])
def test_inputs_that_are_no_forces_need_gains(unit):
    source = log_of(["q1", "q2", "q3"], unit=["Nm", unit, "Nm"])
    message = rf"the inputs are u1 in {unit}, no forces.* model.gain_spread=0.5"
    with pytest.raises(ConfigError, match=message):
        check_known(known(), source)
    for gains in ({"drive_gain": 8.0}, {"drive_gain": [1, 8, 1]}, {"gain_spread": 0.5}):
        check_known(known(**gains), source)
    check_known(known(), log_of(["q1", "q2", "q3"], unit="1"))  # as of a data frame


class Labelled:
    """A source other than a log, known by its labels."""

    labels = ("q1 [rad]", "q2 [rad]", "q3 [rad]")

    def __init__(self, *input_labels):
        self.input_labels = input_labels


def test_other_sources_are_known_by_their_labels():
    check_known(known(), Labelled("tau1 [Nm]", "tau2", "tau3 [N]"))
    with pytest.raises(ConfigError, match=r"the inputs are i2 in A, no forces"):
        check_known(known(), Labelled("tau1 [Nm]", "i2 [A]", "tau3"))
