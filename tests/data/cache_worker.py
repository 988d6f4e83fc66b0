"""What the processes of the cache's test do; imports little, as each of them starts anew."""

import runpy
import time
from pathlib import Path

import numpy as np

CACHE = Path(__file__).parents[2] / "pinn_dyn" / "data" / "cache.py"


def load_slowly(folder, barrier, results):
    """Load an entry whose making takes a while and leaves a line in a file."""
    # The module alone: its package would import PyTorch and Lightning.
    load_or_make = runpy.run_path(str(CACHE))["load_or_make"]

    def make():
        with (folder / "makes.txt").open("a") as file:
            file.write("made\n")
        time.sleep(0.5)
        return {"t": np.array([0.0, 0.5, 1.0])}

    barrier.wait(timeout=600)
    arrays = load_or_make(folder / "cache", "arm", {"mass": 0.3}, make)
    results.put({key: value.tolist() for key, value in arrays.items()})
