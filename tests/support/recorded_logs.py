"""The folder of logs recorded on real robots, and the tests that need it."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LOGS = Path(os.environ.get("PINN_DYN_LOGS", ROOT.parent / "shared" / "data"))

needs_logs = pytest.mark.skipif(
    not LOGS.is_dir(),
    reason=f"no recorded logs: set PINN_DYN_LOGS to their folder ({LOGS} does not exist)",
)
