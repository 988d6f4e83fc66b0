"""The rival of training_loop.py: whole training steps in JAX and optax, jitted as one.

A step picks the batch by index, takes loss and gradient, clips by the global norm and moves the
weights by AdamW.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any

import jax
import jax.numpy as jnp
import jax_networks
import optax
import torch
from torch import Tensor

from pinn_dyn.data.windows import Windows

Loop = Callable[[Iterator[Tensor]], Any]
"""Takes a step at each batch of positions, and gives the weights."""


SCANNED = 20
"""Steps in one call of a scan."""


class JaxLoops:
    """Loops of training steps from the weights of a model.

    Args:
        models: the torch network before its training, or several, which train side by side, each
            on batches of its own.
        windows: all windows, which batches are picked from.
        loss: its name in ``conf/loss``.
        scale: of the loss's residuals, ``(2N,)``.
        step: length of a window, s.
        rates: the learning rate of each step.
    """

    def __init__(
        self,
        models: list[Any],
        windows: Windows,
        loss: str,
        scale: Any,
        step: float,
        rates: list[float],
    ):
        jax.config.update("jax_default_matmul_precision", "highest")  # float32 on a GPU, as torch
        each = [jax_networks.parameters_of(model) for model in models]
        self.alone = len(models) == 1
        self.parameters = each[0] if self.alone else jax.tree.map(lambda *p: jnp.stack(p), *each)
        self.network = jax_networks.Network(models[0])
        self.loss, self.scale = jax_networks.LOSSES[loss], scale
        self.step = step
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
        acceleration = getattr(self.network, spelling)

        def step(carry: Any, index: Any) -> Any:
            p, state = carry
            batch = {name: array[index] for name, array in self.arrays.items()}
            error, gradient = jax.value_and_grad(
                lambda p: self.loss(acceleration, p, batch, self.step, self.scale)
            )(p)
            updates, state = self.chain.update(gradient, state, p)
            return (optax.apply_updates(p, updates), state), error

        return step if self.alone else jax.vmap(step)

    def _carry(self) -> Any:
        p = jax.tree.map(lambda value: value.copy(), self.parameters)
        return p, (self.chain.init if self.alone else jax.vmap(self.chain.init))(p)

    def one_by_one(self, spelling: str) -> Loop:
        """A jitted step, called from Python."""
        step, carry = jax.jit(self._step(spelling), donate_argnums=0), self._carry()

        def run(batches: Iterator[Tensor]) -> Any:
            nonlocal carry
            for index in batches:
                carry, _ = step(carry, index.numpy())
            return jax.block_until_ready(carry)[0]

        return run

    def scan(self, spelling: str) -> Loop:
        """A jitted loop over so many steps at once."""
        step, carry = self._step(spelling), self._carry()
        scanned = jax.jit(lambda carry, order: jax.lax.scan(step, carry, order), donate_argnums=0)

        def run(batches: Iterator[Tensor]) -> Any:
            nonlocal carry
            while order := list(islice(batches, SCANNED)):
                carry, _ = scanned(carry, torch.stack(order).numpy())
            return jax.block_until_ready(carry)[0]

        return run
