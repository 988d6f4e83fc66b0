"""When a training compiles its dynamics, and options that a class does not take."""

import pytest

from pinn_dyn.mechanics.compilation import STEPS_FOR_DERIVATIVE
from pinn_dyn.run.configuration.build import build_part
from pinn_dyn.run.configuration.validation import ConfigError
from pinn_dyn.run.training import trainer


@pytest.fixture
def compiler(monkeypatch):
    """Says whether this machine has a C++ compiler."""

    def set_compiler(there):
        monkeypatch.setattr(trainer, "has_cpp_compiler", lambda: there)

    set_compiler(True)
    return set_compiler


def compiles(choice, steps=STEPS_FOR_DERIVATIVE, accelerator="cpu"):
    return trainer.compiles(choice, steps, {"accelerator": accelerator})


def test_auto_compiles_long_trainings_where_there_is_a_compiler(compiler):
    assert compiles("auto")
    assert not compiles("auto", STEPS_FOR_DERIVATIVE - 2)
    assert compiles(True, 2)
    assert not compiles(False)
    compiler(False)
    assert not compiles("auto")
    with pytest.raises(ConfigError, match=r"no C\+\+ compiler.*set compile=false"):
        compiles(True)


def test_a_gpu_needs_triton_too(compiler, monkeypatch):
    monkeypatch.setattr(trainer, "find_spec", lambda name: None)
    assert not compiles("auto", accelerator="gpu")
    assert compiles("auto")
    with pytest.raises(ConfigError, match=r"no Triton.*set compile=false"):
        compiles(True, accelerator="gpu")


def test_arguments_of_a_part_and_of_the_parts_in_it_are_checked():
    head = {"_target_": "pinn_dyn.models.NoFriction", "hidden": [8], "_partial_": True}
    model = {"_target_": "pinn_dyn.models.LagrangianNetwork", "friction": head}
    with pytest.raises(ConfigError, match=r"no key 'part\.friction\.hidden'"):
        build_part("part", model)
