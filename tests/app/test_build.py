"""When a training compiles its dynamics, and options that a class does not take."""

import pytest

from pinn_dyn.app import trainer
from pinn_dyn.app.config import ConfigError, build_part
from pinn_dyn.mechanics.compilation import STEPS_FOR_DERIVATIVE


@pytest.fixture
def compiler(monkeypatch):
    """Says whether this machine has a C++ compiler."""

    def set_compiler(there):
        monkeypatch.setattr(trainer, "has_cpp_compiler", lambda: there)

    set_compiler(True)
    return set_compiler


def config(choice, steps=STEPS_FOR_DERIVATIVE, accelerator="cpu"):
    return choice, steps, {"accelerator": accelerator}


@pytest.mark.parametrize("choice", [True, False])
@pytest.mark.parametrize("steps", [2, STEPS_FOR_DERIVATIVE])
def test_a_choice_holds_for_any_length(compiler, choice, steps):
    assert trainer.compiles(*config(choice, steps)) is choice


def test_auto_compiles_long_trainings_alone(compiler):
    assert trainer.compiles(*config("auto", STEPS_FOR_DERIVATIVE))
    assert not trainer.compiles(*config("auto", STEPS_FOR_DERIVATIVE - 2))


def test_auto_compiles_where_there_is_a_compiler_alone(compiler):
    compiler(False)
    assert not trainer.compiles(*config("auto"))


def test_a_gpu_needs_triton_too(compiler, monkeypatch):
    monkeypatch.setattr(trainer, "find_spec", lambda name: None if name == "triton" else name)
    assert not trainer.compiles(*config("auto", accelerator="gpu"))
    assert trainer.compiles(*config("auto"))
    with pytest.raises(ConfigError, match=r"no Triton.*install it, or set compile=false"):
        trainer.compiles(*config(True, accelerator="gpu"))
    monkeypatch.setattr(trainer, "find_spec", lambda name: name)
    assert trainer.compiles(*config("auto", accelerator="gpu"))


def test_true_without_a_compiler_says_what_to_install(compiler):
    compiler(False)
    with pytest.raises(ConfigError, match=r"no C\+\+ compiler.*install it, or set compile=false"):
        trainer.compiles(*config(True))


def test_arguments_of_a_part_and_of_the_parts_in_it_are_checked():
    head = {"_target_": "pinn_dyn.models.MeasuredVelocity", "hidden": [8], "_partial_": True}
    model = {"_target_": "pinn_dyn.models.LagrangianNetwork", "initial_velocity": head}
    with pytest.raises(ConfigError, match=r"no key 'part\.initial_velocity\.hidden'"):
        build_part("part", model)


def test_a_missing_argument_is_named_with_its_part():
    with pytest.raises(ConfigError, match=r"part: .*'amplitude'"):
        build_part("part", {"_target_": "pinn_dyn.data.Chirp", "offset": [0.0]})
