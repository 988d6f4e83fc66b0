"""Every code block of the documentation runs, or says why it cannot.

The blocks of a page belong together: Python runs in one namespace, and a block with the name of a
file becomes that file. Commands of the entry points are composed by Hydra, not run, so that every
experiment, option and key that a page names exists; those of a few pages run in test_played_pages.
"""

import importlib.metadata
import importlib.util
import inspect
import re

import hydra
import matplotlib
import pytest
import tomllib
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import ConfigCompositionException, MissingConfigException
from hydra.utils import get_object
from omegaconf import OmegaConf

from pinn_dyn.app.config import CONF, ConfigError, completed, config_folder
from tests.docs.blocks import PAGES, ROOT, blocks
from tests.docs.test_played_pages import PLAYED

PROGRAMS = ("train", "evaluate", "control", "gather")
BLOCKS = [block for page in PAGES for block in blocks(page)]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
TARGETS = re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE)
# Of the shell, or of the system: there is nothing of ours in them to check.
SHELL = {"source", "export", "cd", "git"}
RUNNABLE = {"python", "bash", "sh", "shell", "console", "yaml"}


def of(*languages):
    return [block for block in BLOCKS if block.language in languages and not block.reason]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder for each page, with the files that its blocks are."""
    folders = {}
    for page in PAGES:
        folder = tmp_path_factory.mktemp(page.stem)
        (folder / "examples").symlink_to(ROOT / "examples")
        for block in blocks(page):
            if block.title:
                path = folder / block.title
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(block.text)
        folders[page] = folder
    return folders


def test_there_are_blocks_of_every_kind():
    """The lists come from parsing: an empty one would test nothing."""
    assert len(of("python")) > 5
    assert len(of("yaml")) > 3
    assert len(of("bash")) > 20


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language not in RUNNABLE], ids=str)
def test_other_languages_say_why_they_are_not_run(block):
    assert block.language, "name the language of the block, or indent it"
    if block.language not in ("text", "csv", "markdown"):
        assert block.reason, "put <!-- not run: why --> in the line before"


PYTHON_PAGES = [page for page in PAGES if any(b.page == page for b in of("python"))]


@pytest.mark.parametrize(
    "page",
    [page for page in PYTHON_PAGES if str(page.relative_to(ROOT)) not in PLAYED],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_python_runs(page, files, monkeypatch, capsys):
    monkeypatch.chdir(files[page])
    monkeypatch.syspath_prepend(str(files[page]))
    matplotlib.use("Agg")
    namespace: dict = {"__name__": "docs"}
    for block in of("python"):
        if block.page == page:
            code = compile("\n" * (block.line - 1) + block.text, str(block), "exec")
            exec(code, namespace)


# --- YAML ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("block", of("yaml"), ids=str)
def test_yaml_is_a_configuration(block, files, tmp_path):
    values = yaml.safe_load(block.text)
    assert isinstance(values, dict)
    if block.title and "conf/" in block.title:
        folder, group, option = _location(files[block.page], block.title)
        composed = compose("train", [f"{group}={option}"], folder)
    elif values.keys() <= yaml.safe_load((CONF / "dataset" / "csv_log.yaml").read_text()).keys():
        (tmp_path / "dataset").mkdir()
        text = f"defaults: [csv_log, _self_]\n{block.text}"
        (tmp_path / "dataset" / "of_the_docs.yaml").write_text(text)
        composed = compose("train", ["dataset=of_the_docs"], tmp_path)
    else:
        composed = values
    check_targets(composed, str(files[block.page]))


def _location(folder, title):
    """Configuration folder, group and option of a file such as my_conf/dataset/my_arm.yaml."""
    top, rest = title.split("/", 1)
    group, option = rest.removesuffix(".yaml").split("/", 1)
    return folder / top, group, option


def check_targets(values, folder):
    """Every _target_ exists, and takes the arguments beside it."""
    if isinstance(values, dict):
        if "_target_" in values:
            with pytest.MonkeyPatch.context() as patch:
                patch.syspath_prepend(folder)
                made = get_object(values["_target_"])
            given = {key for key in values if not key.startswith("_")}
            known = inspect.signature(made).parameters
            if not any(p.kind is p.VAR_KEYWORD for p in known.values()):
                assert given <= known.keys(), values["_target_"]
        for value in values.values():
            check_targets(value, folder)
    elif isinstance(values, list):
        for value in values:
            check_targets(value, folder)


# --- commands -----------------------------------------------------------------------------------


@pytest.mark.parametrize("block", of("bash", "sh", "shell", "console"), ids=str)
def test_commands_exist(block, files):
    for words in block.commands():
        check_command(words, files[block.page])


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


FLAGS = {"-m", "--multirun", "--help", "--hydra-help", "--resolve", "--info", "-sc", "--cfg", "job"}


def check_overrides(program, words, folder):
    """Every choice of a command line composes, one change at a time if it is a sweep."""
    if "-sc" in words:
        return
    overrides = []
    for word in words:
        if word.startswith("--config-dir="):
            assert (folder / word.split("=")[1]).is_dir()
        elif word not in FLAGS:
            assert "=" in word or word.startswith("~"), f"{word} is neither a flag nor an override"
            overrides.append(word)
    choices = [_choices(word) for word in overrides]
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
    """The configuration of a command line, with the configuration folders below a folder."""
    candidates = [folder, *sorted(path for path in folder.glob("*conf") if path.is_dir())]
    paths = ",".join(f"file://{path}" for path in candidates)
    words = completed(program, [f"hydra.searchpath=[{paths}]", *overrides])
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(config_folder(program))):
        try:
            cfg = hydra.compose(program, overrides=words)
        except MissingConfigException as error:
            if re.search(r"hydra/(launcher|sweeper)", str(error)):
                pytest.skip(f"needs a plugin of Hydra: {error}")
            raise
    return OmegaConf.to_container(cfg, resolve=False)


@pytest.mark.parametrize(
    "command",
    [
        "python train.py experiment=soft_arm_1/none",
        "python train.py data.pair=4",
        "python train.py -m model=lnn,lmm",
        "python train.py data.pairs",
        "python nothing.py",
        "python benchmarks/training_step.py --none",
        "pinn-dyn-learn model=lnn",
        "make nothing",
        "pip install -e .[nothing]",
        "nothing --at-all",
    ],
)
def test_a_wrong_command_is_seen(command, tmp_path):
    with pytest.raises((AssertionError, ConfigCompositionException, ConfigError)):
        check_command(command.split(), tmp_path)


FOLDERS = [config_folder(program) for program in ("train", "control")]
GROUPS = {
    path.relative_to(folder).as_posix()
    for folder in FOLDERS
    for path in folder.rglob("*")
    if path.is_dir() and "experiment/" not in f"{path.relative_to(folder)}"
}
MENTION = re.compile(r"(?<![\w./@+])\+?(" + "|".join(sorted(GROUPS)) + r")=([\w/]+)(?![\w/.({\[<])")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_options_that_the_text_names_exist(page, files):
    own = {
        p.relative_to(files[page]).as_posix().split("/", 1)[1] for p in files[page].rglob("*.yaml")
    }
    for group, option in MENTION.findall(page.read_text()):
        path = f"{group}/{option}.yaml"
        plugin = group.startswith("hydra/")
        ours = any((folder / path).is_file() for folder in FOLDERS)
        assert ours or path in own or plugin, f"no option {group}={option}"
