"""Names in the reference pages exist, and the configuration reference is complete."""

import ast
import importlib.util
import re

import pytest
import yaml

from pinn_dyn.app.config import CONF
from tests.docs.blocks import PAGES, ROOT

EQUATIONS = (ROOT / "docs" / "equations.md").read_text()


def definitions(path):
    """Return the names of functions and classes of a file."""
    names = set()
    for node in ast.walk(ast.parse((ROOT / path).read_text())):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{x.name}" for x in node.body if isinstance(x, ast.FunctionDef)}
    return names


def test_the_tests_and_the_code_of_every_equation_exist():
    tests = re.findall(r"`((?:tests|pinn_dyn/testing)/[\w/]+\.py)::(\w+)`", EQUATIONS)
    code = re.findall(r"`([\w.]+)`\s+in\s+`(pinn_dyn/[\w/]+\.py)`", EQUATIONS)
    assert len(tests) > 30
    assert len(code) > 25
    for path, name in [*tests, *((path, name) for name, path in code)]:
        assert name in definitions(path), f"{path} has no {name}"


@pytest.fixture(scope="module")
def reference():
    pytest.importorskip("griffe", reason="the configuration reference is made with the docs extra")
    path = ROOT / "docs" / "config_reference.py"
    spec = importlib.util.spec_from_file_location("config_reference", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.config_reference()


def test_the_configuration_reference_has_every_option_and_every_key(reference):
    for path in CONF.rglob("*.yaml"):
        name = path.relative_to(CONF).with_suffix("").as_posix().removeprefix("control/")
        group, _, option = name.rpartition("/")
        if name.startswith("experiment/"):
            assert f"| `{name.removeprefix('experiment/')}` |" in reference
        elif group:
            assert re.search(rf"### `\+?{group}={option}`\n", reference), name
            values = yaml.safe_load(path.read_text()) or {}
            section = re.split(rf"### `\+?{group}={option}`\n", reference)[1].split("\n### ")[0]
            for key in values.keys() - {"defaults", "_target_", "_partial_", "hydra"}:
                assert f"{key}`" in section, f"{name}: {key}"


def test_the_configuration_reference_has_types_and_meanings(reference):
    kind = re.escape("list (whole number > 0)")
    assert re.search(rf"\| `model.mass.hidden` \| `\[32, 32, 32\]` \| {kind} \| \w", reference)
    assert "| `gains.position` | `100.0` | | K\\_P. |" in reference  # comment beside the key


def test_links_lead_to_files_without_a_build():
    """A reader of the repository, without the site, follows them too."""
    for page in PAGES:
        text = re.sub(r"^```.*?^```|`[^`\n]*`", "", page.read_text(), flags=re.M | re.S)
        for link in re.findall(r"(?<!!)\]\(([^)\s:#]+)[)#]", text):
            assert (page.parent / link).exists(), f"{page} links to {link}"
