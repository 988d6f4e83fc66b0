"""What a configuration may hold: our own ones may, keys that stand in no YAML, lengths."""

import pytest

from pinn_dyn.app.build import epochs
from pinn_dyn.app.config import CONF, ConfigError, checked, completed, config_folder
from pinn_dyn.app.keys import KEYS
from pinn_dyn.app.schema import arguments, fits, words
from tests.app.entry import fails
from tests.support.composing import GIVEN, compose


@pytest.mark.parametrize("command", GIVEN)
def test_what_conf_says_is_accepted(command):
    config = checked(command, compose(command))
    assert config.keys() <= KEYS[command].keys()


EXPERIMENTS = [
    (command, path.relative_to(config_folder(command) / "experiment").with_suffix("").as_posix())
    for command in ("train", "control")
    for path in sorted((config_folder(command) / "experiment").rglob("*.yaml"))
]


@pytest.mark.parametrize(("command", "experiment"), EXPERIMENTS)
def test_every_experiment_is_accepted(monkeypatch, command, experiment):
    monkeypatch.setenv("PINN_DYN_LOGS", "logs")
    where = ["dataset=emps", "model.structure.urdf=x"] if experiment == "known" else []
    config = checked(command, compose(command, f"experiment={experiment}", *where))
    if command == "train":
        assert epochs(config)[0] >= 1
    else:
        assert "learned" in config["controllers"]


@pytest.mark.parametrize(
    ("steps", "validations", "expected"),
    [
        (20000, 4, (20, 1000, 5)),
        (60000, 6, (60, 1000, 10)),
        (5000, 25, (25, 200, 1)),
        (500, 10, (10, 50, 1)),
        (5, 1, (1, 5, 1)),
        (4500, 3, (6, 750, 2)),
        (1009, 1, (1, 1009, 1)),  # a prime
    ],
)
def test_an_epoch_is_a_part_of_the_steps_between_validations(steps, validations, expected):
    config = {"trainer": {"steps": steps, "validations": validations}}
    count, batches, every = epochs(config)
    assert (count, batches, every) == expected
    assert count * batches == steps
    assert count == every * validations


@pytest.mark.parametrize(("steps", "validations"), [(100, 3), (3, 100)])
def test_steps_that_are_no_multiple_of_the_validations_say_which_are(steps, validations):
    config = {"trainer": {"steps": steps, "validations": validations}}
    with pytest.raises(ConfigError, match=r"expected a multiple, as trainer.steps=(99|100)"):
        epochs(config)


def test_a_training_of_an_earlier_version_is_not_taken_for_a_new_one():
    config = {"trainer": {"max_epochs": 20, "check_val_every_n_epoch": 5}}
    with pytest.raises(ConfigError, match=r"written by pinn_dyn 0\.2"):
        epochs(config)


# --- keys that stand in no YAML -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "word"),
    [
        ("train", "loss.huber=0.01"),
        ("train", "validator.window=1"),
        ("train", "trainer.precision=bf16-mixed"),
        ("train", "dataset.system.mass=0.4"),
        ("train", "model.angles=[0],[1]"),
        ("train", "resume=runs/x"),
        ("train", "trust=[my_package]"),
        ("control", "actuator.low=-1"),
        ("control", "sensor.q_noise=0.1"),
        ("control", "robot.mass=0.36"),
        ("evaluate", "thresholds.tiny=0.001"),
        ("evaluate", "trust=my_package"),
    ],
)
def test_what_a_class_takes_needs_no_plus(command, word):
    before = [*GIVEN[command], "hydra.run.dir=x", word]
    assert completed(command, before) == [*before[:-1], f"++{word}"]


def test_keys_of_a_yaml_stay_as_they_are():
    before = ["-m", "model=lnn,hnn", "data.pairs=3", "+data.seed=4", "~callbacks.figures"]
    assert completed("train", before) == before


@pytest.mark.parametrize(
    "mistake", ["+sede=1", "++sede=1", "+data.pair=3", "+model.integrator.substep=1"]
)
def test_a_plus_does_not_hide_a_mistake(tmp_path, monkeypatch, capsys, mistake):
    monkeypatch.chdir(tmp_path)
    error = fails("train.py", mistake)
    captured = capsys.readouterr()
    text = f"{captured.out}{captured.err}{error.code}"
    assert "did you mean" in text
    assert "Traceback" not in text


# --- the checks themselves ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "hint", "expected"),
    [
        (1, int, True),
        (True, int, False),
        (1.0, int, False),
        (1, float, True),
        (float("inf"), float, False),
        ("1e-3", float, False),
        (None, int | None, True),
        ([1, 2], tuple[float, float], True),
        ([1], tuple[float, float], False),
        ("ab", list[str], False),
        ({"a": 1}, dict[str, int], True),
        ({"_target_": "x"}, dict[str, int], False),
    ],
)
def test_values_fit_annotations(value, hint, expected):
    assert fits(value, hint) is expected
    assert words(hint)


def test_types_come_from_the_constructors():
    found = arguments("pinn_dyn.data.DynamicsData")
    assert words(found["pairs"]) == "a whole number or all"
    assert words(found["coverage"]) == "a number"
    assert CONF.is_dir()
