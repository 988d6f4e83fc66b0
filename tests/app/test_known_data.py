"""Known mechanics take the joints that the columns name, and refuse currents without gains."""

import logging
import re
from functools import partial

import pandas as pd
import pytest
import torch
import yaml

from pinn_dyn.data import LogSource
from pinn_dyn.models import KnownAndNetwork, KnownMechanics, LagrangianNetwork, Statistics
from pinn_dyn.run.configuration.validation import ConfigError
from pinn_dyn.run.training.known_data import check_known, match_model, match_structure
from pinn_dyn.systems import RigidChain
from pinn_dyn.wording import command_line
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


def joints_of(columns, names=NAMES, **settings):
    return match_structure(RigidChain(urdf(names), **settings), log_of(columns)).joint_names


def test_a_network_gets_the_sine_of_joints_that_turn():
    """A network of the unwrapped angle learns the load of a drive again in each revolution."""
    t = torch.arange(400.0) / 100
    columns = {"t": t, "wheel": 4 * t, "hand": 3 * t.sin(), "slide": 9 * t, "u": 0 * t}
    q = dict(columns=["wheel", "hand", "slide"], unit=["rad", "rad", "m"])
    source = LogSource(
        files=pd.DataFrame(columns),
        time=dict(columns="t", unit="s"),
        q=q,
        u=dict(columns="u", unit="Nm"),
        validation=dict(seconds=0.5, piece=0.5),
        test=dict(seconds=0.5, piece=0.5),
    )
    model, changes = match_model(LagrangianNetwork, source)
    assert changes == {"angles": [0]}
    assert model.keywords == changes
    assert match_model(partial(LagrangianNetwork, angles=[1]), source)[1] == {}


PANDA = [f"panda_joint{k}" for k in (1, 2, 3)] + ["panda_finger_joint1", "panda_finger_joint2"]


@pytest.mark.parametrize(
    ("columns", "names", "joints"),
    [
        (["elbow_pos", "ShoulderPan.pos", "joint1"], NAMES, [NAMES[1], NAMES[0], NAMES[2]]),
        (["q1", "elbow_joint", "x"], NAMES, NAMES),  # by their order
        (["joint10_q", "joint1_q"], ("joint1", "joint10", "joint100"), ["joint10", "joint1"]),
        (["q_3[rad]", "q_1[rad]", "q_2[rad]"], PANDA, [PANDA[2], *PANDA[:2]]),
        (["q2", "q1"], ["joint1", "joint2"], ["joint2", "joint1"]),
        (["joint_0", "joint_1"], ["joint1", "joint2"], ["joint1", "joint2"]),  # numbers from 0
    ],
)
def test_columns_name_the_joints_of_the_coordinates(columns, names, joints):
    assert joints_of(columns, names) == list(joints)


def test_joints_that_no_column_names_are_held_with_a_line(caplog):
    with caplog.at_level(logging.INFO):
        assert joints_of(["joint1", "elbow"]) == ["joint1", "elbow_joint"]
    assert "the joints joint1, elbow_joint; held at zero: shoulder_pan_joint" in caplog.text


def test_effects_of_an_mjcf_that_the_model_leaves_out_are_a_warning(caplog):
    noted = RigidChain(urdf(["a", "b"]).replace("<link", "<note>springs</note><link", 1))
    match_structure(noted, log_of(["a", "b"]))
    assert "the model leaves out of the MJCF: springs" in caplog.text


@pytest.mark.parametrize(
    ("columns", "names"),
    [
        (["elbow", "x", "y"], NAMES),
        (["q1", "q2"], ["left_joint1", "left_joint2", "right_joint1", "right_joint2"]),
    ],
)
def test_columns_that_fit_no_joints_are_refused_with_a_setting_that_works(columns, names, language):
    with pytest.raises(ConfigError, match=r"name the joints of the columns") as error:
        joints_of(columns, names)
    key = {"python": r"as (joints)=(\[.*?\])", "yaml": r"as (model.structure.joints)=(\[.*?\])"}
    advice = yaml.safe_load(re.search(key[language], str(error.value))[2])
    assert joints_of(columns, names, joints=advice) == advice
    with pytest.raises(ConfigError, match="leave out columns"):
        joints_of([*"abcdefg"])


def test_velocities_have_the_order_of_the_joints_of_q():
    log = log_of(["elbow", "joint1"], v=["joint1_v", "elbow_v"])
    assert log.v.columns == ["elbow_v", "joint1_v"]
    assert match_structure(chain(), log).joint_names == ["elbow_joint", "joint1"]


def test_the_inputs_name_the_driven_joints():
    build = partial(KnownMechanics, structure=chain())
    model, changes = match_model(build, log_of(["elbow", "joint1"], ["tau_joint1", "tau_elbow"]))
    assert model.keywords["structure"].joint_names == ["elbow_joint", "joint1"]
    assert model.keywords["driven_joints"] == ["joint1", "elbow_joint"]
    expected = {"structure": {"joints": ["elbow_joint", "joint1"]}}
    assert changes == {**expected, "driven_joints": ["joint1", "elbow_joint"]}
    both = partial(KnownAndNetwork, known=build)
    model, changes = match_model(both, log_of(["elbow", "joint1"], ["tau_elbow"]))
    assert changes == {"known": {**expected, "driven_joints": ["elbow_joint"]}}
    assert model.keywords["known"].keywords["driven_joints"] == ["elbow_joint"]


def test_a_built_model_of_another_order_is_refused():
    crossed = ["elbow", "shoulder_pan", "joint1"]
    with pytest.raises(ConfigError, match=r"build it with joints=\['elbow_joint'"):
        check_known(known(), log_of(crossed))
    with pytest.raises(ConfigError, match=r"^u.columns has the order elbow"):
        check_known(known(), log_of(["q1", "q2", "q3"], crossed))
    with command_line(), pytest.raises(ConfigError, match=r"^dataset.u.columns has the order"):
        check_known(known(), log_of(["q1", "q2", "q3"], crossed))


def test_columns_that_name_no_joint_are_logged_with_their_joints(caplog):
    with caplog.at_level(logging.INFO):
        joints_of(["q1", "q2", "q3"])
    expected = "by their order: q1 -> shoulder_pan_joint; q2 -> elbow_joint; q3 -> joint1"
    assert expected in caplog.text


def test_a_joint_that_turns_is_not_measured_in_metres():
    text = urdf(["slider", "elbow"]).replace(
        '"slider" type="continuous"', '"slider" type="prismatic"'
    )
    structure = RigidChain(urdf=text)
    match_structure(structure, log_of(["q1", "q2"], q_unit=["mm", "deg"]))
    match_structure(structure, log_of(["q1", "q2"], q_unit="1"))
    with pytest.raises(ConfigError, match=r"q1 is in rad, expected m for the joint slider"):
        match_structure(structure, log_of(["q1", "q2"], q_unit=["deg", "mm"]))


def known(**settings):
    ones, increments = torch.ones(3).double(), torch.full((1, 6), 0.01).double()
    values = (0 * ones, ones, -ones, ones, ones, ones, 0 * ones, ones, increments, increments)
    return KnownMechanics(Statistics(*values, 0.01), structure=chain(), **settings)


@pytest.mark.parametrize("unit", ["A", "V"])
def test_inputs_that_are_no_forces_need_gains(unit):
    source = log_of(["q1", "q2", "q3"], unit=["Nm", unit, "Nm"])
    message = rf"the inputs are u1 in {unit}, no forces.* gain_spread=0.5"
    with pytest.raises(ConfigError, match=message):
        check_known(known(), source)
    for gains in ({"drive_gain": 8.0}, {"drive_gain": [1, 8, 1]}, {"gain_spread": 0.5}):
        check_known(known(**gains), source)
    check_known(known(), log_of(["q1", "q2", "q3"], unit="1"))  # as of a data frame
