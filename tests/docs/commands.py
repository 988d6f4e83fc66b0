"""Whether what a command line names exists: scripts, targets, extras, choices of Hydra's."""

import importlib.metadata
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

PROGRAMS = ("train", "evaluate", "control", "gather", "check")
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
TARGETS = re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE)
# Of the shell, or of the system: there is nothing of ours in them to check.
SHELL = {"source", "export", "cd", "git"}


def check_command(words, folder):
    while re.fullmatch(r"[A-Z_]+=.*", words[0]):  # variables of the environment
        words = words[1:]
    program, *rest = words
    if program == "eval":
        inner = re.fullmatch(r"\$\((.*)\)", rest[0])
        assert inner, rest
        check_command(inner[1].split(), folder)
    elif program in ("python", "python3"):
        check_python(rest, folder)
    elif program == "make":
        for word in rest:
            assert "=" in word or word in TARGETS, f"make has no target {word}"
    elif program == "pip":
        for extras in re.findall(r"\[([\w,-]+)\]", " ".join(rest)):
            assert set(extras.split(",")) <= EXTRAS.keys(), f"no such extra: {extras}"
    elif program.startswith("pinn-dyn-"):
        assert program in SCRIPTS, f"no such command: {program}"
        check_overrides(program.removeprefix("pinn-dyn-"), rest, folder)
    elif program not in SHELL:
        known = importlib.metadata.entry_points(group="console_scripts").names
        assert program in known, (
            f"{program} is no command of the environment: put <!-- not run: why --> before it"
        )


def check_python(words, folder):
    script = words[0]
    if script == "-m":
        assert importlib.util.find_spec(words[1]), f"no such module: {words[1]}"
        return
    name = script.removesuffix(".py")
    if name in PROGRAMS:
        check_overrides(name, words[1:], folder)
        return
    path = next((p for p in (ROOT / script, folder / script) if p.is_file()), None)
    assert path, f"no such script: {script}"
    for word in words[1:]:
        if word.startswith("--"):
            assert f'"{word.split("=")[0]}"' in path.read_text(), f"{script} has no {word}"


# What fits every configuration of train.py. A sweep over experiments of nothing else composes the
# first: tests/app/test_configurations.py trains them all.
PLAIN = re.compile(r"(experiment|seed|hydra\.(run|sweep)\.dir)=")
FLAGS = {"-m", "--multirun", "--help", "--hydra-help", "--resolve", "--info", "-sc", "--cfg", "job"}


def check_overrides(program, words, folder):
    """Every choice of a command line composes, one change at a time if it is a sweep."""
    if "-sc" in words:
        return
    overrides = []
    for word in words:
        if word.startswith("--config-dir="):
            assert (folder / word.split("=")[1]).is_dir()
            overrides.append(f"hydra.searchpath=[file://{folder / word.split('=')[1]}]")
        elif word not in FLAGS:
            assert "=" in word or word.startswith("~"), f"{word} is neither a flag nor an override"
            overrides.append(word)
    choices = [_choices(word) for word in overrides]
    if program == "train" and all(map(PLAIN.match, overrides)):
        for option in (option for options in choices for option in options[1:]):
            key, _, value = option.partition("=")
            path = config_folder(program) / key / f"{value}.yaml"
            assert key != "experiment" or path.is_file(), f"no {option}"
        choices = [options[:1] for options in choices]
    first = [options[0] for options in choices]
    for index, options in enumerate(choices):
        for option in options if index == 0 else options[1:]:
            compose(program, [*first[:index], option, *first[index + 1 :]], folder)
    if not choices:
        compose(program, [], folder)


def _choices(word):
    """What a sweep over one override tries, itself for one that is no sweep."""
    (parsed,) = OverridesParser.create().parse_overrides([word])
    if not parsed.is_sweep_override():
        return [word]
    if parsed.is_interval_sweep():
        return [f"{word.split('=')[0]}={parsed.value().start}"]
    return [f"{word.split('=')[0]}={value}" for value in parsed.sweep_string_iterator()]


def compose(program, overrides, folder):
    """The configuration of a command line, with the configuration folders below a folder.

    Types and ranges are checked too, unless a value is missing, which no command of ours gives.
    """
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
    except ConfigCompositionException:  # a key that stands in no YAML, or does not exist
        cfg = _composed(program, completed(program, words))
    HydraConfig.instance().set_config(cfg)
    with open_dict(cfg):
        del cfg["hydra"]
    if not OmegaConf.missing_keys(cfg):
        with pytest.MonkeyPatch.context() as patch:
            for place in (folder, folder.parent):  # classes of the page itself
                patch.syspath_prepend(str(place))
            return checked(program, cfg)
    return OmegaConf.to_container(cfg, resolve=False)


def _composed(program, words):
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(config_folder(program))):
        return hydra.compose(program, overrides=words, return_hydra_config=True)
