"""Configurations that are accepted: our own ones, keys that stand in no YAML, lengths."""

from collections.abc import Callable, Mapping
from typing import Any

import pytest
from pydantic import PositiveInt

from pinn_dyn.app.config import checked, composed, config_folder
from pinn_dyn.data.logs import Columns
from pinn_dyn.mechanics import Integrator
from pinn_dyn.models import CholeskyFactor
from pinn_dyn.run.configuration.validation import ConfigError, check_arguments, check_value
from pinn_dyn.run.training.trainer import epochs
from tests.app.entry import refused_text
from tests.support.composing import REQUIRED, compose


@pytest.mark.parametrize("command", REQUIRED)
def test_what_conf_says_is_accepted(command):
    assert checked(command, compose(command))


LAWS = config_folder("control") / "experiment"


@pytest.mark.parametrize(
    "experiment",
    [path.relative_to(LAWS).with_suffix("").as_posix() for path in sorted(LAWS.rglob("*.yaml"))],
)
def test_every_experiment_of_a_law_is_accepted(experiment):
    """Options of models are trained by tests/app/test_configurations.py."""
    config = checked("control", compose("control", f"experiment={experiment}"))
    assert "learned" in config["controllers"]


@pytest.mark.parametrize(
    ("steps", "validations", "expected"),
    [
        (20000, 4, (20, 1000, 5)),
        (5000, 25, (25, 200, 1)),
        (4500, 3, (6, 750, 2)),
        (1009, 1, (1, 1009, 1)),  # a prime
    ],
)
def test_an_epoch_is_a_part_of_the_steps_between_validations(steps, validations, expected):
    count, batches, every = epochs(steps, validations)
    assert (count, batches, every) == expected
    assert count * batches == steps
    assert count == every * validations


def test_steps_that_are_no_multiple_of_the_validations_say_which_are():
    with pytest.raises(ConfigError, match=r"multiple of validations: set trainer.steps=99"):
        epochs(100, 3)


# --- keys that stand in no YAML -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "word", "path"),
    [
        ("train", "loss.huber=0.01", "loss.huber"),
        ("train", "trust=[my_package]", "trust"),
        ("train", "model.angles=[0],[1]", "model.angles"),
        ("control", "actuator.low=-1", "actuator.low"),
        ("control", "robot.mass=0.36", "robot.mass"),
    ],
)
def test_an_argument_in_no_yaml_needs_no_plus(command, word, path):
    value = composed(command, [*REQUIRED[command], word])
    for key in path.split("."):
        value = value[key]
    assert value is not None


def test_options_of_a_users_own_folder_are_checked(tmp_path):
    (tmp_path / "dataset").mkdir()
    option = tmp_path / "dataset" / "mine.yaml"
    option.write_text("defaults: [soft_arm_1]\nname: mine\n")
    config = composed("train", ["dataset=mine", "dataset.seed=3"], str(tmp_path))
    assert (config["dataset"]["name"], config["dataset"]["seed"]) == ("mine", 3)
    option.write_text("defaults: [soft_arm_1]\nnmae: mine\n")
    with pytest.raises(ConfigError, match=r"no key 'dataset\.nmae': did you mean dataset\.name"):
        composed("train", ["dataset=mine"], str(tmp_path))


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        ("+sede=1", "did you mean seed"),
        ("++model.integrator.substep=1", "did you mean model.integrator.substeps"),
        ("data=[1]", "Hydra cannot use data=[1]"),
        ("data.pairs=${oc.env:NOWHERE_AT_ALL}", "NOWHERE_AT_ALL"),
    ],
)
def test_a_mistake_on_the_command_line_leaves_nothing(
    tmp_path, monkeypatch, capsys, mistake, message
):
    monkeypatch.chdir(tmp_path)
    assert message in refused_text(capsys, "train.py", mistake)
    assert not list(tmp_path.iterdir())


def test_all_mistakes_are_reported_at_once():
    with pytest.raises(ConfigError) as caught:
        composed("train", ["seed=x", "data.pairs=many"])
    assert str(caught.value).splitlines() == [
        "seed is 'x', expected a valid integer",
        "data.pairs is 'many', expected a valid integer or 'all' or 'auto'",
    ]
    with pytest.raises(ConfigError) as caught:
        composed("train", ["loss.hubber=1", "trainer.stpes=1"])
    assert set(str(caught.value).splitlines()) == {
        "the configuration has no key 'loss.hubber': did you mean loss.huber?",
        "the configuration has no key 'trainer.stpes': did you mean trainer.steps?",
    }


@pytest.mark.parametrize(
    ("key", "listed", "hidden"),
    [
        ("optimizer", "lr", "params"),
        ("loss", "huber", "statistics"),
        ("model", "input", "statistics"),
    ],
)
def test_an_unknown_key_lists_only_what_a_user_sets(key, listed, hidden):
    with pytest.raises(ConfigError, match=f"expected .*{listed}") as caught:
        composed("train", [f"{key}.zzz=1"])
    assert hidden not in str(caught.value)


# --- annotations ----------------------------------------------------------------------------------

RK4 = {"_target_": "pinn_dyn.mechanics.RK4"}
HEAD = {"_target_": "pinn_dyn.models.ConstantCholesky", "_partial_": True}
FITTING = [
    ([1, 2], tuple[float, float]),
    (RK4, Integrator),
    (HEAD, Callable[[Any], CholeskyFactor]),
    ({"columns": "a", "unit": "rad"}, Columns | Mapping[str, Any]),
]
UNFITTING = [
    (1.0, int),
    (float("inf"), float),
    ([1], tuple[float, float]),
    (RK4, Callable[[Any], CholeskyFactor]),
    ({**RK4, "substeps": "x"}, Integrator | None),
    ({"columns": "a", "units": "rad"}, Columns | Mapping[str, Any]),
]


@pytest.mark.parametrize(("value", "annotation"), FITTING)
def test_a_value_that_fits(value, annotation):
    check_value("x", value, annotation)


@pytest.mark.parametrize(("value", "annotation"), UNFITTING)
def test_a_value_that_does_not_fit(value, annotation):
    with pytest.raises(ConfigError, match="x"):
        check_value("x", value, annotation)


def test_arguments_of_a_function():
    def play(count: PositiveInt, *, name: str = "a"): ...

    check_arguments(play, {"count": 1})
    for values in ({}, {"count": 0}, {"count": 1, "nam": "b"}):
        with pytest.raises(ConfigError):
            check_arguments(play, values)
