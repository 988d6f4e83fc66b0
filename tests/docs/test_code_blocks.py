"""Every code block of the documentation runs, or states why it cannot.

Python blocks of a page run in one namespace, and a block with a title becomes that file. Commands
are composed by Hydra, so every experiment, option and key of a page exists; the commands of a few
pages run in test_played_pages.py.
"""

import re

import matplotlib
import pytest
from hydra.errors import ConfigCompositionException

from pinn_dyn.app.config import config_folder
from pinn_dyn.run.configuration.validation import ConfigError
from tests.docs.blocks import PAGES, PLAYED, ROOT, blocks
from tests.docs.commands import check_command, compose

BLOCKS = [block for page in PAGES for block in blocks(page)]


def of(language):
    return [block for block in BLOCKS if block.language == language and not block.reason]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder for each page with the files of its blocks."""
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


def test_the_parser_finds_blocks_and_other_languages_have_a_reason():
    assert min(len(of("python")), len(of("yaml")), len(of("bash")) // 4) > 4
    for block in BLOCKS:
        assert block.reason or block.language in ("python", "bash", "yaml", "text"), block


@pytest.mark.parametrize(
    "page",
    [page for page in dict.fromkeys(b.page for b in of("python")) if page.stem not in str(PLAYED)],
    ids=lambda page: page.stem,
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


@pytest.mark.parametrize("block", of("yaml"), ids=str)
def test_yaml_is_a_configuration(block, files, tmp_path):
    if block.title and "conf/" in block.title:
        top, path = block.title.split("/", 1)
        group, option = path.removesuffix(".yaml").split("/", 1)
        compose("train", [f"{group}={option}"], files[block.page] / top)
    else:
        (tmp_path / "dataset").mkdir()
        text = f"defaults: [csv_log, _self_]\n{block.text.split('_self_]')[-1]}"
        (tmp_path / "dataset" / "of_the_docs.yaml").write_text(text)
        compose("train", ["dataset=of_the_docs"], tmp_path)


@pytest.mark.parametrize("page", dict.fromkeys(b.page for b in of("bash")), ids=lambda p: p.stem)
def test_commands_exist(page, files):
    for block in of("bash"):
        for words in block.commands() if block.page == page else ():
            check_command(words, files[page])


@pytest.mark.parametrize(
    "command",
    [
        "python train.py experiment=soft_arm_1/none",
        "python train.py data.pair=4",
        "python train.py -m model=lnn,lmm",
        "python benchmarks/training_step.py --none",
        "make nothing",
    ],
)
def test_a_wrong_command_is_refused(command, tmp_path):
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


def test_options_in_the_text_exist(files):
    for page in PAGES:
        if page.stem == "CHANGELOG":  # has former options
            continue
        own = [path for name in ("*conf", "*conf/control") for path in files[page].glob(name)]
        folders = [*FOLDERS, *(path for path in own if path.is_dir())]
        for group, option in MENTION.findall(page.read_text()):
            path = f"{group}/{option}.yaml"
            known = any((folder / path).is_file() for folder in folders)
            assert known or group.startswith("hydra/"), f"{page}: no option {group}={option}"
