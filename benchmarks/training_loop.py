"""Time of a whole training step, data in memory to updated weights, beside JAX with optax.

Ours is what train.py does: Trainer.fit with the learner, data module, callbacks, checkpoints and
TensorBoard log that the app builds of a configuration, compiled. JAX is a loop around a step that
is jitted as one: it picks the batch by index, takes loss and gradient, clips by the global norm and
moves the weights by AdamW (optax); or a scan of such steps, also jitted, whichever is faster. Both
start from the same network, see the same batches, take the same schedule, and are first checked to
end with the same weights.

    python benchmarks/training_loop.py                       # the tables of README.md
    python benchmarks/training_loop.py --quick               # a smoke run, no file

One core and one thread. After each epoch of ours, JAX takes as many steps, and so does our loss and
gradient alone: what an epoch takes beyond them is the loop and the optimizer. Clocks are the
processor time of the process, which others on the machine hardly disturb.
"""

from __future__ import annotations

import argparse
import csv
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch import Tensor

from pinn_dyn.app import build
from pinn_dyn.app.config import composed
from pinn_dyn.app.provenance import provenance
from pinn_dyn.app.train import describe
from pinn_dyn.data import DataSource, Splits
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.mechanics.compilation import STEPS_FOR_PROGRAM

RESULTS = Path(__file__).parent / "results"
STEP = 2e-3
PAIRS = 16_384
CHECKED = 20
"""Steps after which the weights of both sides are compared."""


class Sines(DataSource):
    """Sums of sines in every coordinate and input; no robot moves so, which costs the same."""

    name = "sines"

    def __init__(self, size: int):
        self.size = size
        self.labels = [f"q{k + 1}" for k in range(size)]
        self.input_labels = [f"u{k + 1}" for k in range(size)]

    def load(self) -> Splits:
        """Six motions of 10 s."""
        generator = torch.Generator().manual_seed(0)
        t = torch.arange(0, 10, STEP, dtype=torch.float64)

        def motion() -> Trajectory:
            rate, phase = 6 * torch.rand(2, 5, 1, self.size, generator=generator).double()
            angle = rate * t[:, None] + phase
            q, v, u = torch.sin(angle).sum(0), (rate * torch.cos(angle)).sum(0), angle.cos().sum(0)
            return Trajectory(q, v, Signal(t, u))

        motions = [motion() for _ in range(6)]
        return Splits(motions[:4], motions[4:5], motions[5:])


def configuration(size: int, batch: int, loss: str, optimizer: str) -> dict[str, Any]:
    words = [
        "model=lnn",
        "model_name=lnn",
        f"loss={loss}",
        f"optimizer={optimizer}",
        "data.stride=1",
        f"data.pairs={PAIRS}",
        f"data.batch_size={batch}",
        f"trainer.steps={STEPS_FOR_PROGRAM}",
        "trainer.validations=1",
        "+trainer.limit_val_batches=0",
        "compile=true",
        "~callbacks.figures",
    ]
    config = composed("train", words)
    config["dataset"] = {"name": "sines", "size": size}
    return config


class Turns(L.Callback):
    """Clocks every epoch, and gives others their turn between two of them.

    Args:
        others: what takes as many steps as an epoch has, by name.
        rounds: epochs until the end, after a first one that compiles.
    """

    def __init__(self, others: dict[str, Callable[[], Any]], rounds: int):
        self.others = others
        self.rounds = rounds
        self.times: list[dict[str, float]] = []
        self._start: float | None = None

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if self._start is None:
            self._start = time.process_time()

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        # What follows of an epoch, such as its checkpoint, counts to the next one.
        assert self._start is not None
        row = {"ours": time.process_time() - self._start}
        for name, run in self.others.items():
            start = time.process_time()
            run()
            row[name] = time.process_time() - start
        self.times.append(row)
        trainer.should_stop = len(self.times) > self.rounds
        self._start = time.process_time()


Loop = Callable[[Iterator[Tensor]], Any]
"""Takes a step at each batch of positions, and gives the weights."""


class JaxLoops:
    """Loops of training steps from the weights of ``model``."""

    def __init__(self, model: Any, data: Any, learner: Any, rates: list[float], loss: str):
        import jax.numpy as jnp
        import jax_networks
        import optax

        self.parameters = jax_networks.parameters_of(model)
        self.network = jax_networks.Network(model)
        self.loss, self.scale = jax_networks.LOSSES[loss], learner.loss.scale.numpy().reshape(-1)
        windows = data.windows.to(torch.device("cpu"), torch.float32)
        pairs = {
            "x0": windows.start("qv"),
            "u": windows.u,
            "measured": windows.increments("qv")[:, 0],
        }
        self.arrays = jax_networks.to_jax(pairs)
        table = jnp.asarray(rates)
        self.chain = optax.chain(
            optax.clip_by_global_norm(1.0),
            optax.adamw(lambda count: table[count], weight_decay=1e-5),
        )

    def _step(self, spelling: str) -> Callable[[Any, Any], Any]:
        import jax
        import optax

        acceleration = getattr(self.network, spelling)

        def step(carry: Any, index: Any) -> Any:
            p, state = carry
            batch = {name: array[index] for name, array in self.arrays.items()}
            error, gradient = jax.value_and_grad(
                lambda p: self.loss(acceleration, p, batch, STEP, self.scale)
            )(p)
            updates, state = self.chain.update(gradient, state, p)
            return (optax.apply_updates(p, updates), state), error

        return step

    def _carry(self) -> Any:
        import jax

        p = jax.tree.map(lambda value: value.copy(), self.parameters)
        return p, self.chain.init(p)

    def one_by_one(self, spelling: str) -> Loop:
        """A jitted step, called from Python."""
        import jax

        step, carry = jax.jit(self._step(spelling), donate_argnums=0), self._carry()

        def run(batches: Iterator[Tensor]) -> Any:
            nonlocal carry
            for index in batches:
                carry, _ = step(carry, index.numpy())
            return jax.block_until_ready(carry)[0]

        return run

    def scan(self, spelling: str) -> Loop:
        """A jitted loop over so many steps at once."""
        import jax

        step, carry = self._step(spelling), self._carry()
        scanned = jax.jit(lambda carry, order: jax.lax.scan(step, carry, order), donate_argnums=0)

        def run(batches: Iterator[Tensor]) -> Any:
            nonlocal carry
            while order := list(islice(batches, CHECKED)):
                carry, _ = scanned(carry, torch.stack(order).numpy())
            return jax.block_until_ready(carry)[0]

        return run


def run_cell(
    size: int, batch: int, loss: str, optimizer: str, rounds: int, steps: int | None
) -> dict[str, object]:
    torch._dynamo.reset()
    if steps is None:  # an epoch has half of the usual steps; of large batches fewer will do
        most = min(max(200_000 // batch, 40), 500)
        steps = next(n for n in range(most, 0, -1) if STEPS_FOR_PROGRAM % n == 0)
    build.LONGEST_EPOCH = steps
    config = configuration(size, batch, loss, optimizer)
    L.seed_everything(0, verbose=False)
    data = build.build_data(config, Sines(size))
    model = build.build_model(config, data.statistics)
    validator = build.build_validator(config, data.statistics.step)
    learner = build.build_learner(config, model, data.statistics, validator)
    rates = schedule(config, learner)
    others: dict[str, Callable[[], Any]] = {}
    chosen = ""
    if optimizer == "adamw":
        chosen, fastest = rival(JaxLoops(model, data, learner, rates, loss), config, data)
        others["jax"] = lambda: fastest(islice(data.sampler(0), steps))
    order = iter(data.sampler(0))
    windows = data.windows.to(torch.device("cpu"), torch.float32)[next(order)]
    others["loss and gradient"] = lambda: [learner._gradients(windows) for _ in range(steps)]
    turns = Turns(others, rounds)
    first = time.perf_counter()
    fit(config, data, learner, validator, turns)
    print(f"{time.perf_counter() - first:.0f} s, of which compiling {turns.times[0]['ours']:.0f} s")
    times = turns.times[1:]

    def median(value: Callable[[dict[str, float]], float]) -> float:
        return statistics.median(value(row) for row in times)

    row: dict[str, object] = {
        "coordinates": size,
        "batch": batch,
        "loss": loss,
        "optimizer": optimizer,
        "ms": round(1e3 * median(lambda row: row["ours"]) / steps, 3),
        "loss_and_gradient_ms": round(
            1e3 * median(lambda row: row["loss and gradient"]) / steps, 3
        ),
        "loop_and_optimizer": round(
            median(lambda row: 1 - row["loss and gradient"] / row["ours"]), 3
        ),
        "jax_ms": round(1e3 * median(lambda row: row["jax"]) / steps, 3) if chosen else "",
        "jax_slower": round(median(lambda row: row["jax"] / row["ours"]), 3) if chosen else "",
        "smallest": round(min(row["jax"] / row["ours"] for row in times), 3) if chosen else "",
        "largest": round(max(row["jax"] / row["ours"] for row in times), 3) if chosen else "",
        "jax_loop": chosen,
        "rounds": len(times),
        "steps_in_a_round": steps,
    }
    print(row, flush=True)
    return row


def rival(loops: JaxLoops, config: dict[str, Any], data: Any) -> tuple[str, Loop]:
    """The fastest loop of JAX, and its name: of two spellings, step by step or as a scan."""

    def checked(make: Callable[[str], Loop], spelling: str) -> tuple[float, str, Loop]:
        run, name = make(spelling), f"{spelling}, {make.__name__}"
        check_weights(config, data, name, run(islice(data.sampler(0), CHECKED)))
        took = []
        for _ in range(5):
            start = time.process_time()
            run(islice(data.sampler(0), CHECKED))
            took.append(time.process_time() - start)
        print(f"{name}: {1e3 * min(took) / CHECKED:.3f} ms", flush=True)
        return min(took), name, run

    found = [checked(loops.one_by_one, spelling) for spelling in ("explicit", "autodiff")]
    spelling = min(found, key=lambda item: item[0])[1].split(",")[0]
    found.append(checked(loops.scan, spelling))
    return min(found, key=lambda item: item[0])[1:]


def fit(config: Any, data: Any, learner: Any, validator: Any, *callbacks: L.Callback) -> None:
    """Train as train.py does, in a folder that is thrown away."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "config.yaml").write_text("")
        trainer = build.build_trainer(
            config, place, data.source, validator, describe(place, config)
        )
        trainer.callbacks = [*callbacks, *trainer.callbacks]  # type: ignore[attr-defined]
        trainer.fit(learner, data)


def schedule(config: dict[str, Any], learner: Any) -> list[float]:
    """The learning rate of each step."""
    optimizer = learner._optimizer([torch.nn.Parameter(torch.zeros(1))])
    steps = config["trainer"]["steps"]
    scheduler = learner._scheduler(optimizer, total_steps=steps)
    rates = []
    for _ in range(steps):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    return rates


def check_weights(config: dict[str, Any], data: Any, name: str, tree: dict[str, Any]) -> None:
    """Compare the weights that JAX has after some steps with ours, uncompiled.

    Raises:
        RuntimeError: if they differ by more than 5 % of the way that they came: Adam divides by the
            size of a gradient, so that rounding counts where that is next to zero.
    """
    from training_step import named

    config = {**config, "compile": False}
    build.LONGEST_EPOCH, steps = CHECKED, build.LONGEST_EPOCH
    data = build.build_data(config, data.source)
    L.seed_everything(0, verbose=False)
    model = build.build_model(config, data.statistics)
    start = {name: p.detach().clone() for name, p in model.named_parameters()}
    validator = build.build_validator(config, data.statistics.step)
    learner = build.build_learner(config, model, data.statistics, validator)
    fit(config, data, learner, validator, Turns({}, 0))
    build.LONGEST_EPOCH = steps
    ours, theirs = dict(model.named_parameters()), named(tree)
    way = sum(float((ours[key].detach() - start[key]).square().sum()) for key in start)
    apart = sum(
        float((ours[key].detach() - theirs[key]).square().sum()) for key in start if key in theirs
    )
    share = (apart / way) ** 0.5
    if not share < 0.05:
        raise RuntimeError(f"{name}: the weights end {share:.2g} of their way apart")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[3, 6, 7], help="N")
    parser.add_argument("--batches", type=int, nargs="+", default=[256, 1024, 8192])
    parser.add_argument("--losses", nargs="+", default=["increment", "midpoint"])
    parser.add_argument("--optimizers", nargs="+", default=["adamw", "soap"])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--steps", type=int, help="steps in a round")
    parser.add_argument("--quick", action="store_true", help="smoke run: one small cell, no file")
    parser.add_argument("--output", type=Path, default=RESULTS / "training_loop.csv")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
    torch.set_num_threads(1)
    if arguments.quick:
        run_cell(2, 32, "midpoint", "adamw", 1, 20)
        return
    rows = [
        run_cell(size, batch, loss, optimizer, arguments.rounds, arguments.steps)
        for optimizer in arguments.optimizers
        for loss in arguments.losses
        for size in arguments.sizes
        for batch in arguments.batches
        if optimizer == "adamw" or batch == min(arguments.batches)
    ]
    ratios = [float(str(row["jax_slower"])) for row in rows if row["jax_slower"]]
    if ratios:
        print(
            f"JAX and optax take {statistics.geometric_mean(ratios):.2f} times as long in the "
            f"geometric mean, {min(ratios):.2f} in the closest cell"
        )
    import jax
    import optax

    record = {key: provenance()[key] for key in ("hardware", "torch", "commit")}
    with arguments.output.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*rows[0], *record, "jax", "optax"])
        writer.writeheader()
        versions = {"jax": jax.__version__, "optax": optax.__version__}
        writer.writerows({**row, **record, **versions} for row in rows)
    print(f"wrote {arguments.output}")


if __name__ == "__main__":
    main()
