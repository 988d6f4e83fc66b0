"""C code without loops: rules for known numbers, overlapping arrays, and vectors."""

import ctypes
import itertools
import mmap
import operator

import numpy as np
import pytest
import torch

from pinn_dyn.exports.exported_function import ExportedFunction, write
from pinn_dyn.exports.scalar_code import ScalarTerms
from pinn_dyn.testing import LinearSystem
from tests.support.c_code import compiled
from tests.support.code_in_c import loop_of
from tests.support.processes import fork

VALUES = {"x": 0.7, "y": -1.3, "yes": True, "no": False}
RULES = {
    "mul": operator.mul,
    "add": operator.add,
    "sub": operator.sub,
    "neg": operator.neg,
    "div": operator.truediv,
    "pow": operator.pow,
    "where": lambda mask, a, b: a if mask else b,
    "logical_and": lambda a, b: bool(a and b),
    "logical_or": lambda a, b: bool(a or b),
    "logical_not": operator.not_,
}
POOLS = {
    "pow": [["x", 2.0], [0.5, 2.0, 3.0]],
    "div": [["x", "-x", 0.0, 1.0], ["x", "-x", 1.0, -1.0]],
    "where": [["yes", "no", 1.0, 0.0], ["x", 2.0], ["y", "x"]],
    **{
        f"logical_{x}": [["yes", "no", 1.0, 0.0]] * n
        for x, n in (("and", 2), ("or", 2), ("not", 1))
    },
}
NUMBERS = ["x", "y", "-x", "-y", 0.0, 1.0, -1.0, 2.0]


def evaluated(terms, term):
    """The number of a term, by Python."""
    name, *rest = terms.entries[term]
    if name in ("known", "leaf"):
        return VALUES.get(rest[0], rest[0])
    rule = RULES.get(name, np.sqrt)
    return rule(*(evaluated(terms, x) for x in rest))


def leaf(terms, value):
    if isinstance(value, float):
        return terms.known(value)
    number = terms.term("leaf", value.removeprefix("-"))
    return terms.apply("neg", number) if value.startswith("-") else number


@pytest.mark.parametrize("name", RULES)
def test_rules_for_known_numbers_do_not_change_a_result(name):
    pools = POOLS.get(name, [NUMBERS] * (1 if name == "neg" else 2))
    for operands in itertools.product(*pools):
        terms = ScalarTerms()
        leaves = [leaf(terms, x) for x in operands]
        expected = float(RULES[name](*(evaluated(terms, x) for x in leaves)))
        result = float(evaluated(terms, terms.apply(name, *leaves)))
        assert result == pytest.approx(expected), operands


def test_arrays_of_a_call_may_overlap(tmp_path):
    """Each output needs an input in whose place an earlier one is written."""
    inputs = {"x": torch.rand(200, 3, generator=torch.manual_seed(0)).double()}
    mixed = lambda x: torch.stack([x[0] + 2 * x[1], x[0] * x[1], x[0]])  # noqa: E731
    path = write([ExportedFunction("mixed", mixed, inputs, ["y"])], tmp_path / "code.c", {})
    numbers = np.array([3.0, 5.0, 7.0])
    pointer = numbers.ctypes.data_as(ctypes.c_void_p)
    compiled(path).code_mixed(pointer, pointer)
    np.testing.assert_array_equal(numbers, [13.0, 15.0, 3.0])


class Odd(LinearSystem):
    """A force with operations that have functions of their own in vectors."""

    def _potential_force(self, q):
        limited = torch.maximum(torch.sqrt(q + 0.2), 0 * q + 0.4).minimum(q.exp())
        # NaN in the first operand below -0.2, and in the second in (0.3, 0.5) and above 0.6.
        reversed_limits = torch.minimum(0.1 + 0 * q, torch.sqrt((q - 0.3) * (q - 0.5)))
        reversed_limits = reversed_limits + torch.maximum(0.1 + 0 * q, torch.log(0.6 - q))
        other = torch.atan2(q, q + 2) + (q.abs() + 1) ** q + torch.fmod(q, 0.3)
        return limited + reversed_limits + other + torch.sigmoid(3 * q) + torch.sign(q)


def test_operations_in_vectors_are_those_of_pytorch_also_of_nan(monkeypatch, tmp_path):
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path))
    model = Odd([[1.0]], [[1.0]], [[0.1]], [[1.0]]).double()
    x = (0.125 * torch.arange(-6, 7)).double()[:, None] * torch.tensor([1.0, 0.0]).double()
    inputs = torch.zeros(13, 1, 4, 1).double()[:, :, : len(model.integrator.nodes)]
    h = torch.tensor([0.1]).double()
    end = torch.stack([model.integration_step(0 * y, y, inputs[0, 0], h[0]) for y in x])
    assert 3 < end.isfinite().all(1).sum() < 10
    for several in (False, True):
        loop = loop_of(model, x[-1], inputs[0, 0], h[0], several)
        found = loop(0 * x, x, inputs, h)[:, 0]
        torch.testing.assert_close(found, end, rtol=1e-12, atol=1e-12, equal_nan=True)


def at_the_end_of_a_page(values):
    """A copy of a tensor behind which nothing can be read."""
    size = values.numel() * values.element_size()
    length = -(-size // mmap.PAGESIZE) * mmap.PAGESIZE
    memory = mmap.mmap(-1, length + mmap.PAGESIZE)
    address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    page = ctypes.c_void_p(address + length), ctypes.c_size_t(mmap.PAGESIZE)
    assert ctypes.CDLL(None).mprotect(*page, 0) == 0
    copy = torch.frombuffer(memory, dtype=values.dtype, count=values.numel(), offset=length - size)
    return copy.copy_(values.flatten()).reshape(values.shape)


def test_lanes_without_a_trajectory_read_nothing(monkeypatch, tmp_path):
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path))
    model = LinearSystem([[1.0]], [[1.0]], [[0.1]], [[1.0]]).double()
    inputs = torch.ones(5, 3, len(model.integrator.nodes), 1).double()
    x, h = torch.ones(5, 2).double(), torch.full((3,), 0.1).double()
    loop = loop_of(model, x[0], inputs[0, 0], h[0], several=True)
    guarded = [at_the_end_of_a_page(values) for values in (0 * x, x, inputs, h)]
    with (tmp_path / "output.txt").open("w") as output:
        process = fork(lambda: loop(*guarded), output)
        process.join(60)
    assert process.exitcode == 0
