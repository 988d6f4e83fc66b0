"""Every code block of the documentation runs, or says why it cannot.

The blocks of a page belong together: Python runs in one namespace, and a block with the name of a
file becomes that file. Commands of the entry points are composed by Hydra, not run, so that every
experiment, option and key that a page names exists; those of a few pages run in test_played_pages.
"""

import inspect
import re

import matplotlib
import pytest
import yaml
from hydra.errors import ConfigCompositionException
from hydra.utils import get_object

from pinn_dyn.app.config import CONF, ConfigError, config_folder
from tests.docs.blocks import PAGES, PLAYED, ROOT, blocks
from tests.docs.commands import check_command, compose

BLOCKS = [block for page in PAGES for block in blocks(page)]
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
        composed = {"dataset": values}
    check_targets(composed["dataset"], str(files[block.page]))


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


@pytest.mark.parametrize(
    "command",
    [
        "python train.py experiment=soft_arm_1/none",
        "python train.py data.pair=4",
        "python train.py -m model=lnn,lmm",
        "python train.py -m experiment=soft_arm_1/hnn,soft_arm_1/none",
        "python train.py data.pairs",
        "python train.py trainer.max_epochs=3",
        "python train.py model.integrator=rosenbrock",
        "python check.py longest_dely=0.1",
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
FOLDERS.append(ROOT / "examples" / "conf")
GROUPS = {
    path.relative_to(folder).as_posix()
    for folder in FOLDERS
    for path in folder.rglob("*")
    if path.is_dir() and "experiment/" not in f"{path.relative_to(folder)}"
}
MENTION = re.compile(r"(?<![\w./@+])\+?(" + "|".join(sorted(GROUPS)) + r")=([\w/]+)(?![\w/.({\[<])")


# The changelog names options of the past.
@pytest.mark.parametrize("page", [x for x in PAGES if x.stem != "CHANGELOG"], ids=str)
def test_options_that_the_text_names_exist(page, files):
    own = {
        p.relative_to(files[page]).as_posix().split("/", 1)[1] for p in files[page].rglob("*.yaml")
    }
    for group, option in MENTION.findall(page.read_text()):
        path = f"{group}/{option}.yaml"
        plugin = group.startswith("hydra/")
        ours = any((folder / path).is_file() for folder in FOLDERS)
        assert ours or path in own or plugin, f"no option {group}={option}"
