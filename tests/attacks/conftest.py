"""Every attack works in an empty folder, and under a watch on what would run foreign code."""

import sys

import pytest
from hypothesis import HealthCheck, settings

from pinn_dyn.exports.compiled import Compiled
from tests.app.conftest import cache, lnn_run, mlp_run, run_of, shared  # noqa: F401

# What hypothesis tries: the same each time, or others for longer.
settings.register_profile(
    "short",
    max_examples=20,
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)
settings.register_profile(
    "long", parent=settings.get_profile("short"), max_examples=20_000, derandomize=False
)
settings.load_profile("short")

# Events of Python itself (PEP 578), raised by whatever starts a program or calls somebody.
WATCHED = {
    *("os.system", "os.exec", "os.fork", "os.posix_spawn", "os.spawn", "os.startfile"),
    *("subprocess.Popen", "pty.spawn", "socket.connect", "webbrowser.open", "ctypes.dlopen"),
}
_seen: list[str] | None = None


def _watch(event, arguments):
    if _seen is not None and event in WATCHED and arguments[:1] != ("git",):  # provenance
        _seen.append(f"{event} {arguments}")


sys.addaudithook(_watch)


@pytest.fixture(autouse=True)
def nothing_runs(tmp_path, monkeypatch):
    """No program is started, nobody is called, and nothing named ``was_here`` appears."""
    global _seen
    monkeypatch.chdir(tmp_path)
    # Our own code in C, whose cache has tests of its own, is not built and not loaded.
    monkeypatch.setattr(Compiled, "find", lambda self, kind: None)
    _seen = []
    yield
    seen, _seen = _seen, None
    assert not seen
    assert not list(tmp_path.rglob("was_here*"))
