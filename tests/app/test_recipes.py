"""Each recipe of CONTRIBUTING.md works in a copy of the package, with nothing else changed."""

import re
import runpy
import shutil
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.app.entry import NO_FIGURES, ROOT, SET_POINTS, TINY
from tests.docs.blocks import blocks
from tests.support.c_code import function_of
from tests.support.processes import fork

PAGE = ROOT / "CONTRIBUTING.md"
TITLES = re.findall(r"^### (.*)", PAGE.read_text(), re.MULTILINE)
RECIPES = [title for title in TITLES if title != "Other extensions"]


def applied(recipe, folder):
    """Apply the files and diffs of a recipe to a copy of the package."""
    for name in ("pinn_dyn", "conf"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for program in ("train.py", "control.py"):
        shutil.copy(ROOT / program, folder)
    lines = PAGE.read_text().splitlines()
    first = lines.index(f"### {recipe}")
    last = next(k for k in range(first + 1, len(lines)) if lines[k].startswith("##"))
    parts = [block for block in blocks(PAGE) if first < block.line <= last]
    assert 1 <= len(parts) <= 3
    for block in parts:
        if block.title:
            assert not (folder / block.title).exists()
            (folder / block.title).write_text(f"{block.text}\n")
        else:
            patch_file(folder, block.text)


def patch_file(folder, diff):
    """Apply a diff of one file."""
    path, *hunks = diff.split("\n@@\n")
    path = folder / path.removeprefix("+++ ")
    text = path.read_text()
    for hunk in hunks:
        lines = hunk.splitlines()
        before = "".join(f"{line[1:]}\n" for line in lines if not line.startswith("+"))
        after = "".join(f"{line[1:]}\n" for line in lines if not line.startswith("-"))
        assert text.count(before) == 1
        text = text.replace(before, after)
    path.write_text(text)


def command(*words):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [*words, "hydra.run.dir=out"])
        runpy.run_path(words[0], run_name="__main__")


def trained(*words):
    """The model of one step of training, and its folder."""
    command("train.py", *TINY, "model=lnn", NO_FIGURES, *words)
    import pinn_dyn

    run = pinn_dyn.load("out")
    assert run.metrics["steps"] == 2
    return run


def friction_head(run):
    import pinn_dyn

    model = trained("model/friction=drag").model
    v = torch.tensor([[2.0, -2.0, 0.0]])
    torch.testing.assert_close(model.friction(2 * v), 4 * model.friction(v))
    from pinn_dyn.models import Drag, KnownMechanics
    from pinn_dyn.systems import RigidChain
    from pinn_dyn.training import LeastSquares

    t, urdf = np.arange(0, 20, 0.02), str(ROOT / "examples" / "double_pendulum.urdf")
    wave = {f"{x}{k}": np.sin((k + 0.3) * t + k) for x in "qu" for k in (1, 2)}
    known = partial(KnownMechanics, structure=RigidChain(urdf), friction=Drag)
    solver = LeastSquares(cutoff=6.0, rollouts=False)
    names = {"q": ["q1", "q2"], "u": ["u1", "u2"]}
    fitted = pinn_dyn.fit(pd.DataFrame(wave | {"t": t}), **names, model=known, optimizer=solver)
    table = pd.read_csv(fitted.folder / "constants.csv")
    assert table.name.str.startswith("drag of").sum() == 2
    with pytest.raises(ValueError, match=r"friction is .*inf.* expected finite numbers"):
        fitted.export("arm.xml")


def loss(run):
    assert trained("loss=absolute").config["loss"]["_target_"].endswith("AbsoluteLoss")


def log_format(run):
    import pinn_dyn

    frame = pd.read_csv(ROOT / "examples" / "example_log.csv")
    with open("log.fwf", "w") as file:
        file.write(frame[frame.run < "run_05"].to_string(index=False))
    columns = ["bend_x", "bend_y", "stretch"], ["torque_x", "torque_y", "force"]
    fitted = pinn_dyn.fit("log.fwf", q=columns[0], u=columns[1], run="run", steps=1)
    assert fitted.metrics["steps"] == 1


def controlled(run, *words):
    """The table of a loop of the true robot."""
    words = [*SET_POINTS, "rate=1000", "duration=0.005", "settled_after=0.002", *words]
    command("control.py", f"run={run}", *words)
    table = pd.read_csv("out/summary.csv").set_index("controller")
    assert (table["stopped"] == 0).all()
    return table


def control_law(run):
    assert controlled(run, "controllers=gravity", "export=law.c").index.tolist() == ["learned"]
    import pinn_dyn

    q, v, other = np.array([0.1, -0.2, 0.2]), np.array([0.5, -1.0, 2.0]), np.ones(3)
    _, _, G, A = pinn_dyn.load(run).terms(q)
    u, *_ = function_of(Path("law.c").absolute(), "law_control")(
        q, v, other, other, other, np.zeros(4)
    )
    np.testing.assert_allclose(u, np.linalg.solve(A, G) - 0.5 * A.T @ v, rtol=1e-8)


def simulator(run):
    plant = "plant={_target_: pinn_dyn.control.euler.EulerPlant, _partial_: true}"
    assert f"'{plant}'" in PAGE.read_text()
    controlled(run, plant, "~controllers.truth", "~controllers.pd")


def export_target(run):
    import pinn_dyn

    model = pinn_dyn.load(run)
    model.export("arm.ts", "forward_dynamics")
    q, v, u = torch.rand(3, 3, generator=torch.manual_seed(0)).double()
    (a,) = torch.jit.load("arm.ts")(q, v, u)
    with pytest.raises(ValueError, match="set real='double'"):
        model.export("float.ts", "forward_dynamics", real="float")
    torch.testing.assert_close(a, torch.as_tensor(model.forward_dynamics(q, v, u)))


USES = (friction_head, loss, log_format, control_law, simulator, export_target)


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_recipe_works_in_a_copy_of_the_package(recipe, tmp_path, monkeypatch, lnn_run):
    (use,) = (use for use in USES if use.__name__ in recipe.lower().replace(" ", "_"))
    applied(recipe, tmp_path)
    monkeypatch.chdir(tmp_path)

    def work():
        for name in [name for name in sys.modules if name.split(".")[0] == "pinn_dyn"]:
            del sys.modules[name]
        sys.path.insert(0, str(tmp_path))
        use(lnn_run)

    with open("output.txt", "w") as output:
        process = fork(work, output)
        process.join(300)
    assert process.exitcode == 0, (tmp_path / "output.txt").read_text()
