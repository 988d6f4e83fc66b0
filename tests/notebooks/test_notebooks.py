"""The notebooks run from a clean kernel and are committed with their outputs."""

import re
from importlib.util import find_spec
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="needs the notebooks extra")
nbclient = pytest.importorskip("nbclient", reason="needs the notebooks extra")

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
NEEDS_PYBULLET = pytest.mark.skipif(
    find_spec("pybullet") is None, reason="needs PyBullet (the panda extra)"
)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def figures(notebook):
    outputs = [output for cell in code_cells(notebook) for output in cell.outputs]
    return sum("image/png" in output.get("data", {}) for output in outputs)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_is_committed_as_it_ran(path):
    notebook = nbformat.read(path, as_version=4)
    counts = [cell.execution_count for cell in code_cells(notebook)]
    assert counts == list(range(1, len(counts) + 1)), "run it from the top: make notebooks"
    outputs = [output for cell in code_cells(notebook) for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    stderr = "".join(output.text for output in outputs if output.get("name") == "stderr")
    assert "Warning" not in stderr
    assert figures(notebook) >= 2
    texts = [output.get("text", "") for output in outputs] + [c.source for c in notebook.cells]
    assert not re.search(r"(^|[\s'\"(])/(home|root|tmp|Users|work)/", "\n".join(texts))


def test_the_trained_models_are_small_and_hold_no_path_of_a_machine():
    files = [file for file in (FOLDER / "models").rglob("*") if file.is_file()]
    assert sum(file.stat().st_size for file in files) < 1_000_000
    for file in files:
        assert not re.search(rb"/(home|root|tmp|Users|work)/", file.read_bytes()), file


# Shorter trainings and loops. The committed outputs have the full lengths.
SHORT = (
    (r"\bsteps=\d{3,}", "steps=20"),
    (r"duration=3\.0", "duration=0.2"),
    (r"duration=5\.0", "duration=2.0"),
)


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(
            path, marks=[NEEDS_PYBULLET, pytest.mark.panda] if "panda" in path.stem else ()
        )
        for path in NOTEBOOKS
    ],
    ids=lambda path: path.stem,
)
def test_it_runs_from_a_clean_kernel(path):
    notebook = nbformat.read(path, as_version=4)
    committed = figures(notebook)
    for cell in code_cells(notebook):
        cell.outputs = []
        for pattern, text in SHORT:
            cell.source = re.sub(pattern, text, cell.source)
    resources = {"metadata": {"path": str(FOLDER)}}
    nbclient.NotebookClient(
        notebook, timeout=1800, kernel_name="python3", resources=resources
    ).execute()
    assert figures(notebook) == committed
