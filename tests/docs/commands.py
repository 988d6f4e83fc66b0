"""Check of command lines: scripts, modules, make targets, and the choices of Hydra exist."""

import importlib.util
import re

import hydra
import pytest
import tomllib
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import ConfigCompositionException, MissingConfigException
from omegaconf import OmegaConf, open_dict

from pinn_dyn.app.config import checked, completed, config_folder
from tests.docs.blocks import ROOT

PROGRAMS = ("train", "evaluate", "control", "gather", "check", "excite")
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
TARGETS = re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE)


def check_command(words, folder):
    while re.fullmatch(r"[A-Z_]+=.*", words[0]):  # environment variables
        words = words[1:]
    program, *arguments = words
    if program in ("python", "python3"):
        check_python(arguments, folder)
    elif program == "make":
        assert all("=" in word or word in TARGETS for word in arguments), words
    else:
        assert program in SCRIPTS, f"no such command: {program}"
        check_overrides(program.removeprefix("pinn-dyn-"), arguments, folder)


def check_python(words, folder):
    script = words[0]
    if script == "-m":
        assert importlib.util.find_spec(words[1]), f"no such module: {words[1]}"
    elif script.removesuffix(".py") in PROGRAMS:
        check_overrides(script.removesuffix(".py"), words[1:], folder)
    else:
        path = next((p for p in (ROOT / script, folder / script) if p.is_file()), None)
        assert path, f"no such script: {script}"
        options = [word.split("=")[0] for word in words[1:] if word.startswith("--")]
        assert all(f'"{option}"' in path.read_text() for option in options), words


FLAGS = {"-m", "--multirun", "--help", "--hydra-help", "--resolve", "--info", "--cfg", "job"}


def check_overrides(program, words, folder):
    """Compose every choice of a command line, one change at a time in a sweep."""
    overrides = []
    for word in words:
        if word.startswith("--config-dir="):
            assert (folder / word.split("=")[1]).is_dir()
            overrides.append(f"hydra.searchpath=[file://{folder / word.split('=')[1]}]")
        elif word not in FLAGS:
            assert "=" in word or word.startswith("~") or program == "evaluate", f"what is {word}?"
            overrides += completed(program, [word]) if "=" not in word else [word]
    choices = [_choices(word) for word in overrides]
    first = [options[0] for options in choices]
    for index, options in enumerate(choices or [[None]]):
        for option in options if index == 0 else options[1:]:
            words = [*first[:index], option, *first[index + 1 :]] if choices else []
            compose(program, words, folder)


def _choices(word):
    """Return the values that a sweep over one override tries."""
    (parsed,) = OverridesParser.create().parse_overrides([word])
    if not parsed.is_sweep_override():
        return [word]
    if parsed.is_interval_sweep():
        return [f"{word.split('=')[0]}={parsed.value().start}"]
    values = list(parsed.sweep_string_iterator())
    if word.startswith("seed="):
        values = values[:1]
    return [f"{word.split('=')[0]}={value}" for value in values]


def compose(program, overrides, folder):
    """Compose and check a command line, with the configuration folders below a folder."""
    candidates = [folder, *sorted(path for path in folder.glob("*conf") if path.is_dir())]
    paths = [f"file://{path}" for path in candidates if any(path.glob("*/*.yaml"))]
    words = [word for word in overrides if not word.startswith("hydra.searchpath")]
    paths += [word.split("=")[1].strip("[]") for word in overrides if word not in words]
    words = [f"hydra.searchpath=[{','.join(paths)}]", *words] if paths else words
    try:
        cfg = _composed(program, words)
    except MissingConfigException as error:
        if re.search(r"hydra/(launcher|sweeper)", str(error)):
            pytest.skip(f"needs a plugin of Hydra: {error}")
        raise
    except ConfigCompositionException:  # a key that is in no YAML, or does not exist
        cfg = _composed(program, completed(program, words))
    HydraConfig.instance().set_config(cfg)
    with open_dict(cfg):
        del cfg["hydra"]
    if OmegaConf.missing_keys(cfg):
        return OmegaConf.to_container(cfg, resolve=False)
    with pytest.MonkeyPatch.context() as patch:
        for path in (folder, folder.parent):  # classes of the page
            patch.syspath_prepend(str(path))
        return checked(program, cfg)


def _composed(program, words):
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(config_folder(program))):
        return hydra.compose(program, overrides=words, return_hydra_config=True)
