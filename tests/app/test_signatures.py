"""Arguments read from source code, beside the signatures of the imported classes."""

import inspect
import pkgutil
import re
import sys
import types

from pinn_dyn.app.config import CONF
from pinn_dyn.run.configuration.signatures import unknown_keys

TEXT = "".join(file.read_text("utf-8") for file in CONF.rglob("*.yaml"))
TARGETS = sorted(set(re.findall(r"_target_: *([\w.]+)", TEXT)) - {"lightning.Trainer"})

ARM = """
import abc, torch
from dataclasses import dataclass

@dataclass
class Link(abc.ABC):
    length: float

@dataclass
class Arm(Link):
    mass: float = 1.0

class Loaded(Arm):
    pass

class Head(torch.nn.Module):
    pass

@torch.jit.script  # any decorator may add arguments
class Wrapped:
    def __init__(self, length): ...

class Free:
    def __init__(self, **options): ...

Alias = Arm
"""


def test_arguments_in_the_source_are_those_of_the_class():
    assert len(TARGETS) > 50
    for target in TARGETS:
        parameters = inspect.signature(pkgutil.resolve_name(target)).parameters.values()
        names = {"_target_": target, **{x.name: None for x in parameters}}
        assert not list(unknown_keys(names, path="part")), target
        if all(x.kind != x.VAR_KEYWORD for x in parameters):
            found = [path for path, _ in unknown_keys({**names, "typo": 1}, path="part")]
            assert found == ["part.typo"], target


def test_a_users_class_is_read_with_its_bases(tmp_path, monkeypatch):
    (tmp_path / "arm_of_mine.py").write_text(ARM)
    monkeypatch.syspath_prepend(tmp_path)
    found = {}
    # Arguments of torch.nn.Module, the base of Head, are not in its source.
    for name in ("Arm", "Loaded", "Head", "Wrapped", "Free", "Alias", "Missing"):
        part = {"_target_": f"arm_of_mine.{name}", "length": 1.0, "mas": 2.0}
        found[name] = [path for path, _ in unknown_keys(part)]
    assert {name: paths for name, paths in found.items() if paths} == {
        "Arm": ["mas"],
        "Loaded": ["mas"],
    }


def test_a_class_of_a_module_without_a_file_is_not_read(monkeypatch):
    monkeypatch.setitem(sys.modules, "arm_of_a_notebook", types.ModuleType("arm_of_a_notebook"))
    for module in ("arm_of_a_notebook", "__main__"):
        assert not list(unknown_keys({"_target_": f"{module}.Arm", "mas": 2.0}))
