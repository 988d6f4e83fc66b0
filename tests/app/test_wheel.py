"""The wheel: its commands work far from the repository, with the configuration inside."""

import os
import shutil
import subprocess
import sys
import zipfile
from importlib import metadata

import pytest

from tests.app.entry import NO_FIGURES, ROOT, TINY


def has_tools():
    """Whether a wheel can be built without a network: with pip and the setuptools it needs."""
    try:
        metadata.version("pip")
        return int(metadata.version("setuptools").split(".")[0]) >= 77
    except metadata.PackageNotFoundError:
        return False


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not has_tools(), reason="building a wheel needs pip and setuptools>=77"),
]


def pip(*arguments):
    command = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", *arguments]
    subprocess.run(command, check=True, timeout=600)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    # From a copy: setuptools leaves a build folder beside the sources.
    source = tmp_path_factory.mktemp("source") / "pinn_dyn"
    source.mkdir()
    for name in ("pinn_dyn", "conf"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, source / name, ignore=ignored)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        if (ROOT / name).is_file():
            shutil.copy(ROOT / name, source)
    folder = tmp_path_factory.mktemp("wheel")
    offline = ["--no-deps", "--no-index", "--no-build-isolation"]
    pip("wheel", *offline, "--wheel-dir", str(folder), str(source))
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    folder = tmp_path_factory.mktemp("installed")
    pip("install", "--no-deps", "--no-index", "--target", str(folder), str(wheel))
    return folder


def call(installed, folder, *command):
    """Run a program on the installed wheel in an empty folder; returns what it printed."""
    done = subprocess.run(
        [sys.executable, *command],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(installed), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_holds_every_module_template_robot_and_configuration(wheel):
    inside = set(zipfile.ZipFile(wheel).namelist())
    modules = {
        str(p.relative_to(ROOT))
        for kind in ("*.py", "*.html", "*.urdf", "py.typed")
        for p in (ROOT / "pinn_dyn").rglob(kind)
    }
    assert any(name.endswith(".html") for name in modules)
    configurations = {f"pinn_dyn/{p.relative_to(ROOT)}" for p in (ROOT / "conf").rglob("*.yaml")}
    assert len(configurations) > 50
    assert {name for name in inside if ".dist-info/" not in name} == modules | configurations


def test_a_training_runs_and_is_gathered(installed, tmp_path):
    script = str(installed / "bin" / "pinn-dyn-train")
    call(installed, tmp_path, script, "model=lnn", *TINY, NO_FIGURES, "hydra.run.dir=run")
    # It took the configuration of the wheel, not the one of the repository.
    sources = (tmp_path / "run" / ".hydra" / "hydra.yaml").read_text()
    assert str(installed / "pinn_dyn" / "conf") in sources
    assert str(ROOT / "conf") not in sources
    gather = str(installed / "bin" / "pinn-dyn-gather")
    assert "runs: 1" in call(installed, tmp_path, gather, "runs=[run]", "hydra.run.dir=table")
    help_text = call(installed, tmp_path, str(installed / "bin" / "pinn-dyn-check"), "--help")
    assert "pinn-dyn-check dataset=my_arm" in help_text
    assert "python check.py" not in help_text
    assert (tmp_path / "table" / "sweep.csv").is_file()
