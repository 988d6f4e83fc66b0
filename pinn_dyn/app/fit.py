"""Training from Python, without a configuration file: what train.py does, on a data frame."""

from __future__ import annotations

import contextlib
import re
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from lightning.pytorch.utilities.seed import isolate_rng

from pinn_dyn.app.command import hush
from pinn_dyn.app.config import ConfigError, composed
from pinn_dyn.app.frame import Signals, frame_dataset, in_frame
from pinn_dyn.app.keys import KEYS, Count
from pinn_dyn.app.learned_model import LearnedModel, load
from pinn_dyn.app.run_folder import CONFIG, claimed
from pinn_dyn.app.schema import check_value
from pinn_dyn.app.train import train_in
from pinn_dyn.app.words import OVERRIDE
from pinn_dyn.data import DataSource, store

STEPS = 1000
"""Of the optimizer, on a data frame: a minute or two."""
TRAJECTORIES = "trajectories.npz"
"""In a run folder, the data of a source that Python made."""
_VALIDATIONS = 10  # at most, in such a training


def fit(
    data: pd.DataFrame | DataSource | str,
    *,
    q: Signals | None = None,
    u: Signals | None = None,
    v: Signals | None = None,
    time: Signals = "t",
    run: str | None = None,
    model: str = "lnn",
    steps: int | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    overrides: Sequence[str] = (),
) -> LearnedModel:
    """Train a model, as train.py does, and return it.

    A data frame is read, checked and cleaned as the log reader does it with a file, one row per
    sample. Of five runs or more, some are kept whole for validation and test, as
    ``config["dataset"]`` then says; of fewer, the last 15 % of each are for the test and the 15 %
    before them for validation. What is returned did best in roll-outs of the validation.

    Args:
        data: a data frame; or a data source, or the name of a data set, such as ``"soft_arm_1"``.
        q, u, v: columns of the configuration, the input and, where it was measured, the velocity:
            ``{"columns": [...], "unit": "deg"}``, with one unit for all or one for each, and what
            else :class:`~pinn_dyn.data.logs.Columns` takes; or names alone, taken in SI units.
        time: column of the time, as q; a name alone is in s.
        run: column that tells runs apart; None where all rows are one run.
        model: ``"lnn"``, ``"hnn"``, ``"acceleration"`` or ``"mlp"``.
        steps: of the optimizer; None: 1,000 for a data frame, else as train.py.
        seed: of the weights and the batches, and of the choice of runs.
        folder: run folder that is written, for load, evaluate.py and control.py; None: none stays.
        overrides: anything else, in the words of a command line: ``["optimizer.lr=0.002"]``.

    Raises:
        TypeError: if q or u is missing beside a data frame, or given beside other data.
        ValueError: on columns, units, clocks or settings that cannot be used; names them.
        NonFiniteLossError: if the loss becomes NaN or infinite.
    """
    seed, steps = _whole(seed), _whole(steps)
    overrides = _words(overrides, own_data=not isinstance(data, str))
    with contextlib.ExitStack() as stack:
        temporary = folder is None
        if folder is None:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="pinn_dyn-"))
        if not isinstance(folder, (str, Path)) or not str(folder) or "${" in str(folder):
            raise ConfigError(f"folder is {folder!r}, expected the name of one, or None")
        try:
            place = Path(folder).expanduser().resolve()
            place.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            raise ConfigError(f"folder is {folder}, which cannot be written to: {error}") from error
        if (place / CONFIG).exists():
            raise ConfigError(f"folder is {place}, which holds a training: give another one")
        for name, number in (("seed", seed), ("steps", 1 if steps is None else steps)):
            check_value(name, number, KEYS["train"]["seed"] if name == "seed" else Count)
        if not re.fullmatch(r"\w+", str(model)):
            raise ConfigError(f"model is {model!r}, expected the name of one, as 'lnn'")
        words = [f"model={model}", f"model_name={model}", f"seed={seed}"]
        if isinstance(data, pd.DataFrame):
            if q is None or u is None:
                raise TypeError("fit(frame) lacks columns: expected fit(frame, q=[...], u=[...])")
            signals = {"time": time, "q": q, "u": u} | ({} if v is None else {"v": v})
            words += frame_dataset(data, signals, run, seed, place)
            if steps is None:
                steps = STEPS
        elif not isinstance(data, (str, DataSource)):
            raise TypeError(
                f"data is a {type(data).__name__}, expected a data frame, as of pandas.read_csv, a "
                "data source or the name of a data set"
            )
        elif any(given is not None for given in (q, u, v, run)):
            raise TypeError(
                "q, u, v and run describe a data frame: leave them out beside a data set"
            )
        elif isinstance(data, str):
            words.append(f"dataset={data}")
        else:
            words.append(f"dataset.name={data.name}")
        if steps is not None:
            words += [f"trainer.steps={steps}", f"trainer.validations={_validations(steps)}"]
        config = composed("train", [*words, *overrides])
        if temporary:
            config["callbacks"].pop("figures", None)  # which nobody could see
        source = data if isinstance(data, DataSource) else None
        if source is not None:
            # An object has no configuration: its trajectories stay in the run folder.
            config["dataset"] = store(source, place / TRAJECTORIES)
        threads = torch.get_num_threads()
        stack.callback(torch.set_num_threads, threads)
        try:
            with isolate_rng(), warnings.catch_warnings(), claimed(place, config):
                hush()
                train_in(place, config, source=source)
        except ConfigError as error:
            if not isinstance(data, pd.DataFrame):
                raise
            raise ConfigError(in_frame(str(error), data, place)) from error
        except SystemExit as stop:  # Lightning's end of an interrupted training
            raise KeyboardInterrupt from stop
        return load(place)


def _whole(number: Any) -> Any:
    """A whole number of NumPy as one of Python; anything else as it is."""
    return int(number) if isinstance(number, np.integer) else number


def _words(overrides: Sequence[str], *, own_data: bool) -> list[str]:
    """Overrides that are some, and choose neither other data nor what only train.py has.

    Raises:
        ConfigError: naming the one that is not.
    """
    given = [] if isinstance(overrides, (str, Mapping)) else list(overrides or ())
    if not given and overrides:
        raise ConfigError(f"overrides is {overrides!r}, expected a list, as ['optimizer.lr=0.002']")
    for word in given:
        if not isinstance(word, str) or not OVERRIDE.match(word):
            raise ConfigError(f"overrides has {word!r}, expected words as 'optimizer.lr=0.002'")
        key = word.lstrip("+~").partition("=")[0]
        if key.split(".")[0].split("/")[0] == "hydra" or (own_data and key == "dataset"):
            raise ConfigError(f"overrides has '{word}', which is for train.py: leave it out")
    return given


def _validations(steps: int) -> int:
    """The most validations, up to ten, that divide the steps evenly."""
    return max(count for count in range(1, _VALIDATIONS + 1) if steps % count == 0)
