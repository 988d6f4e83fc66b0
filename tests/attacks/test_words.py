"""Words of a command line that name nothing, or too much: a sentence before anything runs."""

import numpy as np
import pytest

from pinn_dyn.app.build import try_step
from pinn_dyn.app.config import ConfigError, completed, composed
from pinn_dyn.app.flags import in_order
from pinn_dyn.app.parts import build_part
from pinn_dyn.data.simulation import check_amount
from pinn_dyn.training import SOAP
from tests.app.entry import refused_text

WORDS = [
    ("train", ["~validator"], "'~validator' takes away a key that train.py needs"),
    ("train", ["~name"], "'~name' takes away a key"),
    ("train", ["~seed"], "'~seed' takes away a key"),
    ("evaluate", ["~split"], "'~split' takes away a key that evaluate.py needs"),
    ("control", ["~plant"], "'~plant' takes away a key that control.py needs"),
    ("gather", ["~plot"], "'~plot' takes away a key that gather.py needs"),
    ("train", ["model=5"], "model is 5, expected the name of an option: .*lnn"),
    ("train", ["dataset=null"], "dataset is None, expected the name of an option: .*soft_arm_1"),
    ("train", ["data=[1,2]"], r"data is \[1, 2\], expected the name of an option"),
    ("train", ["loss=[[1],[2]]"], "loss is .*, expected the name of an option"),
    ("train", ["model/mass=3"], "model/mass is 3, expected the name of an option: .*network"),
    ("train", ["hydra=3"], "hydra is 3, expected the name of an option"),
    ("control", ["plant=[null]"], r"plant is \[None\], expected .*: bullet, simulated"),
    ("train", ["model=lagrangian"], "'model/lagrangian' does not exist: did you mean lnn"),
    ("train", ["optimizer=adam"], r"'optimizer/adam' does not exist: did you mean adamw\?"),
    ("train", ["dataset=softarm1"], "did you mean .*soft_arm_1"),
    ("train", ["experiment=soft_arm"], "did you mean .*soft_arm_1"),
    ("control", ["reference=sett_point"], r"did you mean set_point"),
    ("train", ["model.inverse_mass.hidden.x=3"], "hidden is .*, which has no keys"),
    ("check", ["dataset=range(3)"], "dataset is 0, expected the name of an option: .*example_log"),
    ("check", ["dataset=${.}"], r"dataset is '\$\{\.\}', expected the name of an option"),
    ("check", ["dataset=/dev/full"], "'dataset//dev/full' does not exist. Options of dataset: csv"),
    ("check", ["dataset.q.sgn=1"], "no key 'dataset.q.sgn': did you mean dataset.q.sign"),
    ("check", ["dataset.test={secnds: 1, piece: 1}"], "did you mean dataset.test.seconds"),
    ("check", ["dataset.steps.x={a: 1}"], "no key 'dataset.steps.x'.* To add it, put a \\+ before"),
    ("gather", ["filter.a=1"], "no key 'filter.a': filter is null, give filter={a: ...}"),
    ("train", ["trainer.stpes=3"], "no key 'trainer.stpes': did you mean (?!.*max_steps).*steps"),
    ("control", ["guard.treshold=3"], "no key 'guard.treshold': did you mean guard.threshold"),
    ("train", ["dataset.labels=é"], "in quotes what has other signs than plain letters"),
    ("train", ["hydra.job.env_set.A=1"], r"put a \+ before one that is new, as '\+hydra.job.env_s"),
    ("train", ["hydra.job.env_copy=[NOWHERE]"], "cannot start with hydra.job.env_copy=.*NOWHERE"),
    ("train", ["seed=range(1,1)"], "is a sweep over 0 values"),
    ("train", ["seed=range(1000000000000)"], r"is a sweep over 1e\+12 values"),
    ("train", ["seed=[1"], r"'seed=\[1' cannot be read: expected key=value"),
    (
        "train",
        ["optimizer={_target_: torch.optim.SGD, momentum: 1}"],
        "no key 'optimizer.momentum'",
    ),
]


@pytest.mark.parametrize(("command", "words", "says"), WORDS, ids=[x[1][0] for x in WORDS])
def test_words_that_name_nothing(command, words, says):
    with pytest.raises(ConfigError, match=says) as caught:
        completed(command, words)
    assert "search path" not in str(caught.value)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["~optimizer.lr"], r"^optimizer\.lr is missing"),
        (["~trainer.steps"], r"^trainer\.steps is missing"),
        (["~dataset.name"], "dataset.name' not found: give it, or leave out what"),
        (["seed=${seed}"], "seed: Recursive interpolation"),
        (["data.pairs=${oc.env:NOWHERE_AT_ALL}"], r"data\.pairs: .*NOWHERE_AT_ALL.*: set it, or"),
        (["data=[1]"], "data is"),
        (["dataset.system=[1]"], r"dataset.system: .*: give \[\.\.\.\] for a list, \{"),
        (["dataset.step=${.}"], r"dataset.step: .*: expected \$\{key\}, as \$\{seed\}"),
    ],
)
def test_keys_that_are_taken_away_in_a_part(words, says):
    with pytest.raises(ConfigError, match=says):
        composed("train", ["model_name=x", *words])


LOG = [*("dataset=csv_log", "dataset.files=a.csv", "dataset.q={columns: a, unit: rad}")]
LOG += ["dataset.u={columns: b, unit: Nm}", "dataset.validation={seconds: 1, piece: 1}"]


def test_keys_of_short_forms_need_no_plus():
    words = ["dataset.test.seconds=2", "dataset.test.piece=1", "dataset.q.sign=-1"]
    dataset = composed("check", [*LOG, *words, "dataset.shortest=0.5"])["dataset"]
    assert dataset["shortest"] == 0.5
    assert dataset["test"] == {"seconds": 2, "piece": 1}
    assert dataset["validation"] == {"seconds": 1, "piece": 1}
    assert dataset["q"] == {"columns": "a", "unit": "rad", "sign": -1}


def test_a_set_point_for_each_run_has_the_right_kind():
    words = ["run=x", "reference.q=[[0.1, 0.1, 0.2], [0, 0, 0.2]]"]
    assert len(composed("control", words)["reference"]["q"]) == 2


FLAGS = [
    (["--resolve"], "--resolve belongs to --cfg, .*: give --cfg job with it"),
    (["-p", "model"], "--package belongs to --cfg"),
    (["--cfg", "job", "-m"], "--multirun and --cfg do not go together: give one of them"),
    (["--run", "--multirun"], "--run and --multirun do not go together"),
    (["--cfg"], "argument --cfg/-c: expected one argument"),
    (["--cfg", "x"], "invalid choice: 'x'"),
    (["-cn", "evaluate"], "--config-name is evaluate, expected none, as train.py has its own"),
    (["-cp", "/tmp"], "--config-path is /tmp, expected none, .*: add groups .* by --config-dir"),
    (["-cd", "/nowhere"], "--config-dir is /nowhere, expected a folder with groups"),
    (["--experimental-rerun", "x"], "reads a pickle, which may run code"),
    (["--multirum", "seed=1"], "unrecognized arguments: --multirum. A key has no dashes"),
    (["--seed=1"], "unrecognized arguments: --seed=1. A key has no dashes, as seed=1"),
    (["-sc"], "lacks one of install, uninstall, query"),
    *[([word], f"'{word}' is no override, expected key=value") for word in ("seed", "", "=", "-")],
    (["runs/x", "-m"], "'runs/x' is no override"),
]


@pytest.mark.parametrize(("words", "says"), FLAGS, ids=[" ".join(x[0]) for x in FLAGS])
def test_flags_that_do_not_go(words, says):
    with pytest.raises(ConfigError, match=says):
        in_order("train", words)


def test_flags_stand_anywhere():
    ordered = ["-m", "--config-dir", ".", "model=lnn", "seed=1,2"]
    assert in_order("train", ["model=lnn", "-m", "seed=1,2", "--config-dir", "."]) == ordered
    assert in_order("train", ["seed=1", "--cfg", "job", "a=2"]) == ["--cfg", "job", "seed=1", "a=2"]
    completion = ["-sc", "install=bash"]
    assert in_order("train", completion) == completion


@pytest.mark.parametrize(
    "words", [["hydra.job_logging.version=3"], ["-m", "hydra.launcher=null"], ["--run", "-m"]]
)
def test_settings_of_hydra_that_break_it(monkeypatch, capsys, words):
    said = refused_text(capsys, "gather.py", "runs=[x]", *words)
    assert "Hydra cannot start with hydra." in said or "do not go together" in said


def test_what_a_constructor_lacks_is_named_with_its_place():
    head = {"_target_": "pinn_dyn.data.Chirp", "offset": [0.0]}
    with pytest.raises(ConfigError, match=r"'amplitude' of part is missing: give part\.amplitude="):
        build_part("part", head)


@pytest.mark.parametrize(
    ("settings", "steps", "says"),
    [
        ({"lr": 0.1, "betas": (1, 1)}, 5, "^optimizer: its settings are refused .*beta"),
        ({"lr": 0.1, "precondition_frequency": 0}, 5, "^optimizer: its settings are refused"),
        ({"lr": 0.1}, 0, "^scheduler: its settings are refused .*total_steps"),
    ],
)
def test_what_the_first_step_refuses(settings, steps, says):
    from functools import partial

    from pinn_dyn.training import one_cycle

    with pytest.raises(ConfigError, match=says):
        try_step(partial(SOAP, **settings), one_cycle, steps)


@pytest.mark.parametrize(("motions", "duration", "step"), [(10**9, 1.0, 0.1), (1, 1e300, 1e-300)])
def test_data_that_no_memory_holds(motions, duration, step):
    with np.errstate(over="ignore"), pytest.raises(ValueError, match=r"arm: .* expected at most"):
        check_amount("arm", motions, duration, step, 9)
