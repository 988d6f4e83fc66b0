"""Constants of C code as arguments, for models with the same structure to share the code."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pinn_dyn.exports.c_code import ConstantArrays
from pinn_dyn.exports.program import Program


class LiveNumbers(ConstantArrays):
    """Constant arrays whose numbers the code reads from its argument ``values``.

    The code contains the numbers 0, 1 and -1, which often follow from the structure of the model.
    Another model can share the code only if it has the same numbers at these positions.

    Args:
        programs: the programs of the code.
        numbers: all constants of the programs in a row, ``(n,)``.

    Attributes:
        index: positions in ``numbers`` of the entries of ``values``.
        fixed: numbers that the code contains, by position.
    """

    arguments = ("values",)

    def __init__(self, programs: Sequence[Program], numbers: Tensor):
        super().__init__("double")
        self._numbers = numbers
        self._starts: dict[int, int] = {}
        self._places: dict[bytes, int] = {}
        self.index: list[int] = []
        self.fixed: dict[int, float] = {}
        start = 0
        for values in (x for program in programs for x in program.stored()):
            self._starts[values.untyped_storage().data_ptr()] = start
            if not values.dtype.is_floating_point:  # the code contains indices and booleans
                self.fixed |= enumerate(values.flatten().double().tolist(), start)
            start += values.numel()

    def name(self, values: Tensor) -> str:
        if not values.dtype.is_floating_point:
            return super().name(values)
        return f"(VALUES + {self._place(self._positions(values))})"

    def elements(self, values: Tensor) -> list[float | str]:
        if not values.dtype.is_floating_point:
            return super().elements(values)
        positions = self._positions(values)
        start = self._place(positions)
        numbers: list[float | str] = []
        for k, position in enumerate(positions.tolist()):
            number = self._fixed(position)
            numbers.append(f"VALUES[{start + k}]" if number is None else number)
        return numbers

    def common(self, values: Tensor) -> float | None:
        if not values.dtype.is_floating_point:
            return super().common(values)
        positions = self._positions(values).tolist()
        numbers = {self._fixed(position) for position in positions}
        return numbers.pop() if len(numbers) == 1 else None

    def spread(self, text: str) -> str:
        return f"lanes({text})"

    def _positions(self, values: Tensor) -> Tensor:
        """Return the positions of the numbers of a stored constant, or of a view of it."""
        storage = values.untyped_storage()
        places = torch.arange(storage.nbytes() // values.element_size())
        view = places.as_strided(values.shape, values.stride(), values.storage_offset())
        return view.flatten() + self._starts[storage.data_ptr()]

    def _place(self, positions: Tensor) -> int:
        key = positions.numpy().tobytes()
        if key not in self._places:
            self._places[key] = len(self.index)
            self.index += positions.tolist()
        return self._places[key]

    def _fixed(self, position: int) -> float | None:
        """Return the number at a position if it is 0, 1 or -1."""
        number = float(self._numbers[position])
        if abs(number) not in (0.0, 1.0):
            return None
        self.fixed[position] = number
        return number
