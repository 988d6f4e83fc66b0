"""Known mechanics are refused on data of other joints, and on currents that have no gains."""

import logging

import pytest

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.known_data import check_known
from pinn_dyn.data import LogSource
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


def config(names=NAMES, network=False, locked=(), **settings):
    structure = {"_target_": "pinn_dyn.systems.RigidChain", "urdf": urdf(names)}
    structure |= {"locked_joints": list(locked)}
    known = {"_target_": "pinn_dyn.models.KnownMechanics", "_partial_": True} | settings
    known["structure"] = structure
    both = {"_target_": "pinn_dyn.models.KnownAndNetwork", "_partial_": True, "known": known}
    return {"model": both if network else known}


@pytest.mark.parametrize("network", [False, True], ids=["known", "known and network"])
def test_a_crossed_order_is_refused_with_the_right_one(network):
    source = log_of(["elbow_pos", "ShoulderPan.pos", "joint1_pos"])
    place = "model.known" if network else "model"
    message = (
        r"dataset.q.columns is in the order elbow_pos, ShoulderPan.pos, joint1_pos, and "
        rf"{place}.structure has the joints shoulder_pan_joint, elbow_joint, joint1: expected .*"
        r"dataset.q.columns=\[ShoulderPan.pos,elbow_pos,joint1_pos\]"
    )
    with pytest.raises(ConfigError, match=message):
        check_known(config(network=network), source)


@pytest.mark.parametrize("signal", ["v", "u"])
def test_crossed_velocities_or_inputs_are_refused_too(signal):
    crossed = {signal: ["a_shoulder_pan", "a_joint1", "a_elbow"]}
    with pytest.raises(ConfigError, match=rf"dataset.{signal}.columns is in the order"):
        check_known(config(), log_of(["q1", "q2", "q3"], **crossed))


@pytest.mark.parametrize(
    "columns",
    [["shoulder_pan", "elbow", "joint1"], ["q1", "q2", "q3"], ["q1", "elbow_joint", "x"]],
)
def test_the_order_of_the_joints_passes(columns):
    check_known(config(), log_of(columns))


def test_a_longer_name_is_not_taken_for_a_shorter_one():
    names = ("joint1", "joint10", "joint100")
    check_known(config(names), log_of(["joint1_q", "joint10_q", "joint100_q"]))
    with pytest.raises(ConfigError, match=r"\[joint1_q,joint10_q,joint100_q\]"):
        check_known(config(names), log_of(["joint10_q", "joint1_q", "joint100_q"]))


def test_columns_that_name_no_joint_are_mapped_aloud(caplog):
    with caplog.at_level(logging.INFO):
        check_known(config(), log_of(["q1", "q2", "q3"], ["u_shoulder_pan", "u_elbow", "u_joint1"]))
    expected = "by their order: q1 -> shoulder_pan_joint; q2 -> elbow_joint; q3 -> joint1"
    assert expected in caplog.text  # u names its joints


@pytest.mark.parametrize(
    ("columns", "locked", "message"),
    [
        (["shoulder_pan", "joint1"], [], r"lock them, .*locked_joints=\[elbow_joint\]"),
        (
            ["shoulder_pan"],
            ["elbow_joint"],
            r"lock them, model.structure.locked_joints=\[elbow_joint,joint1\]",
        ),
        (["q1", "q2"], [], r"q.columns has 2 entries, q1, q2, .* Lock the others: model.structure"),
        (
            ["shoulder_pan", "elbow", "joint1", "gripper"],
            [],
            "Leave out the columns that are no joints, gripper by their names",
        ),
    ],
)
def test_other_joints_than_columns_are_listed(columns, locked, message):
    with pytest.raises(ConfigError, match=message):
        check_known(config(locked=locked), log_of(columns))


@pytest.mark.parametrize("unit", ["A", "mA", "V", "%"])
def test_inputs_that_are_no_forces_need_gains(unit):
    source = log_of(["q1", "q2", "q3"], unit=["Nm", unit, "Nm"])
    shown = {"mA": "A"}.get(unit, unit)
    message = rf"the inputs are u1 in {shown}, and model.drive_gain is 1.* model.gain_spread=0.5"
    with pytest.raises(ConfigError, match=message):
        check_known(config(), source)
    with pytest.raises(ConfigError, match=r"model.drive_gain is \[1, 1, 2\]"):
        check_known(config(drive_gain=[1, 1, 2]), source)
    for gains in ({"drive_gain": 8.0}, {"drive_gain": [1, 8, 1]}, {"gain_spread": 0.5}):
        check_known(config(**gains), source)


def test_a_joint_that_turns_is_not_measured_in_metres():
    one = config(["slider", "elbow"])
    structure = one["model"]["structure"]
    structure["urdf"] = structure["urdf"].replace(
        '"slider" type="continuous"', '"slider" type="prismatic"'
    )
    check_known(one, log_of(["q1", "q2"], q_unit=["mm", "deg"]))
    check_known(one, log_of(["q1", "q2"], q_unit="1"))
    message = (
        r"q1 is in rad, and joint slider of model.structure slides: expected m;.*dataset.q.unit"
    )
    with pytest.raises(ConfigError, match=message):
        check_known(one, log_of(["q1", "q2"], q_unit=["deg", "mm"]))


def test_units_that_nobody_said_pass_and_so_do_other_models():
    check_known(config(), log_of(["q1", "q2", "q3"], unit="1"))  # as of a data frame
    other = {"_target_": "pinn_dyn.models.LagrangianNetwork"}
    check_known({"model": other}, log_of(["x"], unit="A"))


class Labelled:
    """Another source than a log, known by its labels."""

    labels = ("q1 [rad]", "q2 [rad]", "q3 [rad]")

    def __init__(self, *input_labels):
        self.input_labels = input_labels


def test_other_sources_are_known_by_their_labels():
    check_known(config(), Labelled("tau1 [Nm]", "tau2", "tau3 [N]"))
    with pytest.raises(ConfigError, match=r"the inputs are i2 in A, and model.drive_gain is 1"):
        check_known(config(), Labelled("tau1 [Nm]", "i2 [A]", "tau3"))
    with pytest.raises(ConfigError, match=r"dataset.input_labels has 2 entries, tau1"):
        check_known(config(), Labelled("tau1 [Nm]", "tau2 [Nm]"))
