"""Words of a command line that name nothing, or too much: a sentence before anything runs."""

import numpy as np
import pytest

from pinn_dyn.app.build import _try_step
from pinn_dyn.app.config import ConfigError, completed, composed
from pinn_dyn.app.parts import build_part
from pinn_dyn.data.simulation import check_amount
from pinn_dyn.training import SOAP

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
    ("train", ["experiment=soft_arm_1/hn"], "did you mean .*hnn"),
    ("control", ["reference=sett_point"], r"did you mean set_point"),
    ("train", ["model.inverse_mass.hidden.x=3"], "hidden is .*, which has no keys"),
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
    ],
)
def test_keys_that_are_taken_away_in_a_part(words, says):
    with pytest.raises(ConfigError, match=says):
        composed("train", ["model_name=x", *words])


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
        _try_step(partial(SOAP, **settings), one_cycle, steps)


@pytest.mark.parametrize(("motions", "duration", "step"), [(10**9, 1.0, 0.1), (1, 1e300, 1e-300)])
def test_data_that_no_memory_holds(motions, duration, step):
    with np.errstate(over="ignore"), pytest.raises(ValueError, match=r"arm: .* expected at most"):
        check_amount("arm", motions, duration, step, 9)
