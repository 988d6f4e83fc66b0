"""Values of the wrong kind: each ends in one line with the key, what was found and expected."""

import hydra
import pytest
import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from pinn_dyn.app.build import epochs
from pinn_dyn.app.config import CONF, ConfigError, checked, completed, config_folder
from pinn_dyn.app.schema import KEYS, arguments, fits, words
from tests.app.entry import fails

GIVEN = {
    "train": [],
    "evaluate": ["runs=[x]"],
    "control": ["run=x", "reference.q=[0,0,0]"],
    "gather": ["runs=[x]"],
    "check": [],
}


def compose(command, *overrides):
    folder = str(config_folder(command))
    with hydra.initialize_config_dir(version_base="1.3", config_dir=folder):
        given = GIVEN[command][: None if not overrides else 1]  # experiments have references
        cfg = hydra.compose(command, overrides=[*given, *overrides], return_hydra_config=True)
    HydraConfig.instance().set_config(cfg)
    OmegaConf.set_struct(cfg, False)
    if command == "train":
        cfg.model_name = cfg.hydra.runtime.choices.model
    del cfg["hydra"]
    return cfg


@pytest.fixture(scope="module")
def composed():
    """Of each command the configuration without any override."""
    return {command: compose(command) for command in GIVEN}


MISTAKES = {
    "train": [
        "seed=abc",
        "seed=1.5",
        "seed=-1",
        "seed=true",
        "seed=null",
        "seed=[1]",
        "name=3",
        "threads=0",
        "threads=100000",
        "threads=two",
        "ensemble=0",
        "ensemble=2.5",
        "compile=yes please",
        "compile=1",
        "start_from=3",
        "resume=[a]",
        "trust=1",
        "sede=1",
        "dataset.duration=long",
        "dataset.duration=nan",
        "dataset.duration=inf",
        "dataset.duration=-1",
        "dataset.step=null",
        "dataset.train_inputs=ten",
        "dataset.test=1.5",
        "dataset.labels=x",
        "dataset.labels=[1,2,3]",
        "dataset.configurations.bent=x",
        "dataset.system=3",
        "dataset.system.segments=0",
        "dataset.system.segments=one",
        "dataset.system.mass=heavy",
        "dataset.system.mass=nan",
        "dataset.system.nodes=0",
        "dataset.nothing=1",
        "dataset.pairing=both",
        "dataset.compile=maybe",
        "data=1",
        "data.pairs=many",
        "data.pairs=0",
        "data.pairs=1.5",
        "data.pairs=null",
        "data.steps=0",
        "data.stride=-1",
        "data.coverage=2",
        "data.coverage=nan",
        "data.batch_size=0",
        "data.batch_size=[1]",
        "data.seed=x",
        "data.batches_per_epoch=3",
        "model.substeps=0",
        "model.substeps=half",
        "model.hidden=[8]",
        "model.angles=x",
        "model.angles=[a]",
        "model.angles=0",
        "model.inverse_mass=3",
        "model.inverse_mass.hidden=8",
        "model.inverse_mass.hidden=[8,x]",
        "model.inverse_mass.hidden=[0]",
        "model.inverse_mass.epsilon=small",
        "model.potential.quadratic=1",
        "loss.huber=nan",
        "loss.curriculum=fast",
        "loss.velocity_weight=x",
        "loss.hubber=1",
        "optimizer.lr=0",
        "optimizer.lr=-0.1",
        "optimizer.lr=nan",
        "optimizer.lr=fast",
        "optimizer.weight_decay=-1",
        "scheduler.warm_up=x",
        "validator.horizon=nan",
        "validator.horizon=0",
        "validator.horizon=two",
        "validator.window=0",
        "validator.step=x",
        "callbacks=1",
        "callbacks.figures=1",
        "callbacks.figures.every_n_validations=x",
        "logger.tensorboard=1",
        "trainer.steps=ten",
        "trainer.steps=0",
        "trainer.steps=1.5",
        "trainer.validations=0",
        "trainer.max_epochs=3",
        "trainer.gradient_clip_val=-1",
        "trainer.gradient_clip_val=x",
        "trainer.acelerator=cpu",
        "trainer.callbacks=[]",
    ],
    "evaluate": [
        "runs=3",
        "runs=null",
        "checkpoint=first",
        "split=train",
        "horizon=nan",
        "horizon=0",
        "horizon=-1",
        "horizon=far",
        "step=0",
        "step=x",
        "windows=text",
        "windows=[text]",
        "windows=[0]",
        "windows=1",
        "thresholds=3",
        "thresholds.small=x",
        "thresholds.small=0",
        "trajectory=-1",
        "trajectory=first",
        "threads=0",
        "threads=100000",
        "horizn=1",
    ],
    "control": [
        "run=[x]",
        "checkpoint=none",
        "member=-1",
        "gains=3",
        "gains.position=x",
        "gains.position=nan",
        "duration=0",
        "duration=nan",
        "rate=0",
        "rate=fast",
        "samples_rate=0",
        "initial_states=3",
        "initial_states={q_low: [0]}",
        "runs=0",
        "runs=[x]",
        "seed=x",
        "robot=3",
        "actuator=3",
        "actuator.low=x",
        "actuator.lowest=1",
        "sensor.q_noise=x",
        "delay=0.5",
        "delay=-1",
        "stability=3",
        "export=3",
        "settle_fraction=0",
        "settle_fraction=2",
        "settled_after=-1",
        "settled_after=nan",
        "trajectory=x",
        "animate=1",
        "controllers=1",
        "reference=1",
        "plant=1",
        "ruun=x",
    ],
    "gather": [
        "runs=3",
        "evaluations=3",
        "filter=3",
        "filter=[a]",
        "sort=3",
        "sort=null",
        "plot=[x]",
        "plot_column=3",
        "sorted=x",
    ],
}


@pytest.mark.parametrize(
    ("command", "mistake"), [(name, one) for name in MISTAKES for one in MISTAKES[name]]
)
def test_a_wrong_value_is_refused_by_name(composed, command, mistake):
    key, _, text = mistake.partition("=")
    cfg = composed[command].copy()
    OmegaConf.update(cfg, key, yaml.safe_load(text.replace("nan", ".nan").replace("inf", ".inf")))
    with pytest.raises(ConfigError) as caught:
        checked(command, cfg)
    said = str(caught.value)
    assert key.split(".")[-1] in said
    assert "\n" not in said
    assert len(said) < 400
    assert "expected" in said or "takes no" in said or "no key" in said or "to be set" in said


@pytest.mark.parametrize("command", GIVEN)
def test_what_conf_says_is_accepted(composed, command):
    config = checked(command, composed[command])
    assert config.keys() <= KEYS[command].keys()


EXPERIMENTS = [
    (command, path.relative_to(config_folder(command) / "experiment").with_suffix("").as_posix())
    for command in ("train", "control")
    for path in sorted((config_folder(command) / "experiment").rglob("*.yaml"))
]


@pytest.mark.parametrize(("command", "experiment"), EXPERIMENTS)
def test_every_experiment_is_accepted(monkeypatch, command, experiment):
    """With +debug=fast too, which has to shorten every training."""
    monkeypatch.setenv("PINN_DYN_LOGS", "logs")
    where = ["dataset.root=x", "dataset.files=x"] if experiment[:4] in ("neck", "pand") else []
    if "_real" not in experiment and "neck" not in experiment:
        where = []
    fast = ["+debug=fast"] if command == "train" else []
    config = checked(command, compose(command, f"experiment={experiment}", *where, *fast))
    if command == "train":
        assert epochs(config) == (1, 5, 1)
        assert config["compile"] is False


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


@pytest.mark.parametrize("mistake", ["+sede=1", "++sede=1", "+data.pair=3", "+model.substep=1"])
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
    assert words(found["pairs"]) == "a whole number"
    assert words(found["coverage"]) == "a number"
    assert CONF.is_dir()
