"""A soft arm of many segments, end to end: simulated, learned, tested and controlled.

    python benchmarks/many_segments.py runs/arm_16                 # 16 segments, N = 48
    python benchmarks/many_segments.py runs/arm_4 --segments 4

The experiment with 16 segments of docs/what_we_tried.md: it runs train.py, evaluate.py and
control.py, each in a folder below the one that is given, with lists of three numbers a segment.
Of 16 segments the simulation takes 4 minutes of the processor, once, the training 6.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def listed(values: Sequence[float | str], segments: int) -> str:
    """Values of one segment as the list of all of them."""
    return f"[{','.join(str(value) for value in [*values] * segments)}]"


def training(segments: int) -> list[str]:
    """Overrides of train.py: segments of 0.05 kg, driven by sines of 0.3 Nm and N."""

    def every(*values: float) -> str:
        return listed(values, segments)

    def named(*names: str) -> str:
        return f"[{','.join(f'{name}{k + 1}' for k in range(segments) for name in names)}]"

    sines = f"offset: {every(0.0, 0.0, 0.0)}, amplitude: {every(0.3, 0.3, 0.3)}"
    return [
        "dataset=soft_arm_2",
        f"dataset.name=soft_arm_{segments}",
        f"dataset.system.segments={segments}",
        "dataset.system.mass=0.05",
        f"dataset.system.stiffness={every(2.0, 2.0, 50.0)}",
        f"dataset.system.damping={every(0.005, 0.005, 0.05)}",
        f"dataset.excitation.parts=[{{_target_: pinn_dyn.data.MultiSine, {sines}}}]",
        f"dataset.initial_states.q_low={every(-0.1, -0.1, 0.0)}",
        f"dataset.initial_states.q_high={every(0.1, 0.1, 0.1)}",
        f"dataset.initial_states.v_max={every(0.1, 0.1, 0.02)}",
        f"dataset.labels={named('x', 'y', 'l')}",
        f"dataset.input_labels={named('tx', 'ty', 'f')}",
        f"dataset.configurations={{straight: {every(0.0, 0.0, 0.05)}}}",
        "~dataset.configurations.bent",
        *("dataset.duration=3", "dataset.test_duration=3", "dataset.step=0.002"),
        *("dataset.train_initial_states=16", "dataset.train_inputs=16"),
        *("dataset.validation=2", "dataset.test=4"),
        *("model=lnn", "loss=midpoint", "compile=true", "data.pairs=20000", "data.stride=1"),
        *("model.mass.hidden=[64,64]", "model.potential.hidden=[64,64]"),
        *("model.input.hidden=[32,32]", "validator.horizon=0.5"),
        *("trainer.steps=4000", "trainer.validations=4"),
    ]


def control(segments: int) -> list[str]:
    """Overrides of control.py: it holds a bent set point, where the arm starts."""
    return [
        *("checkpoint=last", "controllers=regulation", "reference=set_point"),
        f"reference.q={listed((0.05, 0.03, 0.03), segments)}",
        *("gains.position=1", "gains.velocity=0.005", "rate=1000"),
        *("duration=0.6", "settled_after=0.4", "animate=false"),
    ]


def main() -> None:
    """Run the three programs one after another."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--segments", type=int, default=16)
    given = parser.parse_args()
    run = (given.folder / "training").resolve()
    programs = {
        "train": training(given.segments),
        "evaluate": [f"runs=['{run}']", "windows=[0.1,0.5]"],
        "control": [f"run='{run}'", *control(given.segments)],
    }
    for name, words in programs.items():
        folder = run if name == "train" else run.parent / name
        command = [sys.executable, str(ROOT / f"{name}.py"), *words, f"hydra.run.dir='{folder}'"]
        subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
