"""Stage of a fit of constants that is kept, over ten splits of the double pendulum.

    PINN_DYN_LOGS=... python -m benchmarks.stage_choice [splits]

A split has two test runs. Each of the other eight is the validation run of one fit, whose training
runs are the other seven. The first of these fits is that of a user. Test errors are means over
windows of 1 s.
"""

import copy
import sys
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from benchmarks.configured import build_data, build_model, build_validator
from pinn_dyn.app.config import composed
from pinn_dyn.evaluation.prediction import predict_trajectories
from pinn_dyn.mechanics import Predictor, stack, stack_until
from pinn_dyn.run.configuration.build import build_part, build_source

SETTINGS = ["experiment=known", "dataset=double_pendulum", "model/friction=coulomb"]
SETTINGS += ["model.structure.urdf=examples/double_pendulum.urdf", "model.start=prior"]
SETTINGS += ["data.stride=10", "validator.horizon=1"]


def configuration(*more: str) -> dict[str, Any]:
    """Return the configuration of the entry ``double_pendulum/known`` with changes."""
    return composed("train", [*SETTINGS, *more])


@dataclass
class Stages:
    """Models after the stages of a fit, their validation errors, and the test motions."""

    models: list[Predictor]
    errors: list[float]
    kept: Predictor
    test: list[Any]
    step: float

    def test_error(self, model: Predictor) -> float:
        """Return the mean error of windows of 1 s of the test runs, rad."""
        with torch.no_grad():
            prediction = predict_trajectories(model, stack(self.test), window=1.0, step=self.step)
        return float(prediction.error().mean())


def fitted(validation: str, test: list[str]) -> Stages:
    """Fit the constants with one validation run."""
    config = configuration(f"dataset.validation.runs=['{validation}']", f"dataset.test.runs={test}")
    data = build_data(config)
    model = build_model(config, data.statistics)
    validator = build_validator(config, data.statistics.step)
    truth, models, errors = stack_until(data.splits.validation), [], []

    def validate(present: Predictor) -> Tensor:
        with torch.no_grad():
            parts = validator.part_errors(present, truth)
        models.append(copy.deepcopy(present))
        errors.append(float(parts.mean()))
        return parts

    solver = build_part("optimizer", config["optimizer"])
    solver.fit(model, data.splits.train, data.windows, validate=validate)
    return Stages(models, errors, model, data.splits.test, data.statistics.step)


def main(count: int) -> None:
    """Print the test errors of the choices of each split, and their means."""
    runs = sorted({item.raw.run for item in build_source(configuration()).cleaned})
    rows = []
    for k in range(count):
        test = [runs[k], runs[(k + len(runs) // 2) % len(runs)]]
        others = [name for name in runs if name not in test]
        others = others[k % len(others) :] + others[: k % len(others)]
        fits = [fitted(name, test) for name in others]
        first, stages = fits[0], min(len(x.errors) for x in fits)
        left_out = torch.tensor([x.errors[:stages] for x in fits]).mean(dim=0)
        errors = [first.test_error(x) for x in first.models]
        chosen = errors[int(left_out.argmin())]
        rows.append([first.test_error(first.kept), chosen, min(errors), errors[0]])
        print(f"split {k}:", *(f"{x:.4f}" for x in rows[-1]), flush=True)
    means = torch.tensor(rows).mean(dim=0).tolist()
    names = ["kept by the validation run", "kept by eight runs left out", "best stage"]
    for name, mean in zip([*names, "inverse dynamics"], means, strict=True):
        print(f"{name}: {mean:.4f} rad after 1 s")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
