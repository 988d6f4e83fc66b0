"""Settings for all tests."""

import gc
import os
from contextlib import nullcontext

import pytest
import torch

from pinn_dyn.wording import command_line
from tests.support.compositions import keep_compositions

gc.disable()  # until all is imported

# The tests' tensors are small: threads beyond one only slow them down.
torch.set_num_threads(1)

# Files that take half a minute each, some with few tests: with --no-loadscope-reorder they are
# begun first, so that at the end no worker waits long for another.
LONG = (
    *("test_configurations", "test_code_blocks", "test_sweep_jobs", "test_known_runs"),
    *("test_known_systems", "test_played_pages", "test_examples", "test_least_squares"),
    *("test_log_training", "test_evaluation", "test_control", "test_planted_faults"),
    *("test_c_loop", "test_pipeline", "test_api", "test_report", "test_log_check"),
    # Of make test-slow.
    *("test_notebooks", "test_slurm", "test_wheel", "test_workers", "test_integrators"),
    *("test_random_chains", "test_export", "test_known_laws", "test_gradients", "test_learner"),
    *("test_every_model", "test_delay", "test_rigid_chain", "test_robot"),
)


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path.stem not in LONG)


def pytest_collection_finish():
    # What is imported stays: a collection of garbage need not go through it, a fifth of a second.
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def kept_compositions():
    """What makes Hydra faster, to be undone in a copy of this process."""
    with pytest.MonkeyPatch.context() as patch:
        keep_compositions(patch)
        yield patch


@pytest.fixture(scope="session", autouse=True)
def _figures_without_layout():
    """The places of the axes take as long as all that is drawn in them."""
    with pytest.MonkeyPatch.context() as patch:
        engine = "matplotlib.layout_engine.ConstrainedLayoutEngine.execute"
        patch.setattr(engine, lambda *_: None)
        yield


@pytest.fixture(params=["python", "yaml"])
def language(request):
    """What the reader of messages writes: both are followed."""
    with command_line() if request.param == "yaml" else nullcontext():
        yield request.param


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory):
    """The verdicts of checks and decoded bags of tests stay out of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        if "PINN_DYN_CACHE" not in os.environ:
            patch.setenv("PINN_DYN_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def traced(monkeypatch):
    """Programs that are traced and decomposed as ever, but not built: that takes far longer.

    Each kind of program is built by one test.
    """
    monkeypatch.setattr("torch._inductor.compile", lambda graph, *_: graph)


@pytest.fixture
def few_states(monkeypatch):
    """Compare an export with its original at ten states instead of 200."""
    monkeypatch.setattr("pinn_dyn.exports.exported_function.STATES", 10)


@pytest.fixture
def undrawn(monkeypatch):
    """No pictures, pages and linear models as baselines: they take longer than all else."""
    monkeypatch.setattr("pinn_dyn.app.control_results._figures", lambda *_: {})
    monkeypatch.setattr("pinn_dyn.app.control_results.control_report", lambda **_: "")
    monkeypatch.setattr("pinn_dyn.log_check.check.LogCheck.save", lambda *_: "nowhere")
    evaluation = "pinn_dyn.evaluation"
    monkeypatch.setattr(f"{evaluation}.Evaluation.figures", lambda *_: iter(()))
    monkeypatch.setattr(f"{evaluation}.Evaluation.page", lambda *_: "")

    def left_out(*_, **__):
        raise ValueError("left out")

    monkeypatch.setattr(f"{evaluation}.baselines.fit_linear_rival", left_out)
