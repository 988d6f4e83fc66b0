"""Logs that hypothesis damages: refused in a sentence, or read as they are.

Some hundred here, the same ones each time. Others, for longer:
``pytest tests/attacks --hypothesis-profile=long -k fuzz``.
"""

import contextlib
import csv
import functools
import re
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pinn_dyn.data.logs import LogError
from tests.attacks.damage import byte_hits, hit, places
from tests.attacks.formats import DAMAGED, formatted
from tests.data.log_formats import FORMATS
from tests.data.logs_files import motion, source

COLUMNS = ["t", "q1", "v1", "u1", "q2", "v2", "u2"]
ODD = [
    *("", " ", "nan", "inf", "-inf", "1e400", "-0", "1e300", "1e-320", "0x1F", "1_0", "1d3"),
    *("1,5", "1;5", '"', '""', "'", "#", "\t", "\0", "\ufeff", "\u00bd", "\uff11", "\u22121"),
    *("1e", "--1", "true", "12:30", "[1]", "1+2j", "None", "NA", "9" * 400, "1" + "0" * 310),
    *("\u2028", "\x85", "\r"),
]
# By its categories: hypothesis would try the codec on each of a million characters.
CHARACTERS = st.characters(exclude_categories=["Cs"])
texts = st.sampled_from(ODD) | st.text(CHARACTERS, max_size=8) | st.floats().map(repr)


@functools.cache
def lines():
    return tuple(motion(5.0).to_csv(index=False, float_format="%.9g").splitlines())


def cell(row, column, text):
    cells = row.split(",")
    cells[column % len(cells)] = text
    return ",".join(cells)


def with_cell(rows, where, column, text):
    k = where % len(rows)
    return [*rows[:k], cell(rows[k], column, text), *rows[k + 1 :]]


def without_line(rows, where):
    k = where % len(rows)
    return [*rows[:k], *rows[k + 1 :]]


def with_line(rows, where, line):
    k = where % len(rows)
    return [*rows[:k], line, *rows[k:]]


def with_line_again(rows, where, there):
    return with_line(rows, there, rows[where % len(rows)])


def with_column(rows, column, text):
    return [rows[0], *(cell(row, column, text) for row in rows[1:])]


def with_columns_exchanged(rows, one, other):
    def exchanged(row):
        cells = row.split(",")
        i, k = one % len(cells), other % len(cells)
        cells[i], cells[k] = cells[k], cells[i]
        return ",".join(cells)

    return [rows[0], *map(exchanged, rows[1:])]


def cut(rows, where):
    return rows[: 1 + where % len(rows)]


def separated(rows, separator):
    return [row.replace(",", separator) for row in rows]


small = st.integers(0, 6)
changes = st.one_of(
    st.tuples(st.just(with_cell), places, small, texts),
    st.tuples(st.just(with_cell), st.just(0), small, texts),
    st.tuples(st.just(without_line), places),
    st.tuples(st.just(with_line), places, texts),
    st.tuples(st.just(with_line_again), places, places),
    st.tuples(st.just(with_column), small, texts),
    st.tuples(st.just(with_columns_exchanged), small, small),
    st.tuples(st.just(cut), places),
    st.tuples(st.just(separated), st.sampled_from(";\t| ")),
)


def read(source_of):
    """The stretches of a log as they were read; None where it is refused, in a sentence."""
    start = time.perf_counter()
    said, splits = None, None
    try:
        splits = source_of.load()
    except LogError as error:
        said = str(error)
    assert time.perf_counter() - start < 10
    if said is not None:
        assert 20 < len(said) < 1500
        return None
    for one in [*splits.train, *splits.validation, *splits.test]:
        for name in ("t", "q", "v", "u"):
            assert getattr(one, name).isfinite().all()
    return [part.raw for part in source_of.cleaned]


def rows_of(content):
    """The numbers of a text by their time: each line below the header by Python's own reader.

    Of several headers the last one counts.
    """
    found, names, separator = {}, [], ","
    for line in re.split("[\r\n]+", content):
        if not set(COLUMNS) <= set(names):
            separator = max(",;\t |", key=line.count)
        row = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
        titles = [name.strip() for name in row]
        if not set(COLUMNS) <= set(names) or (not found and set(COLUMNS) <= set(titles)):
            names = titles
            continue
        values = dict(zip(names, row, strict=False))
        with contextlib.suppress(KeyError, ValueError):  # lines that hold no row
            t, *others = (number(values[name]) for name in COLUMNS)
            found[t] = others
    return found


def number(text):
    """Switches are logged as true and false."""
    switch = {"true": 1.0, "false": 0.0}.get(text.lower())
    return float(text) if switch is None else switch


@given(st.lists(changes, min_size=1, max_size=4))
def test_a_damaged_table_is_refused_or_read_as_it_is(tmp_path_factory, edits):
    rows = list(lines())
    for change, *arguments in edits:
        rows = change(rows, *arguments)
        if not rows:
            return
    content = "\n".join(rows) + "\n"
    folder = tmp_path_factory.mktemp("log")
    (folder / "run.csv").write_text(content, encoding="utf-8", errors="surrogatepass", newline="")
    raws = read(source(folder))
    if raws is None:
        return
    expected = rows_of(content)
    for raw in raws:
        found = np.stack([raw.q, raw.v, raw.u], axis=-1).reshape(len(raw), -1)
        np.testing.assert_allclose(found, [expected[t] for t in raw.t], rtol=1e-12)


@pytest.mark.parametrize("name", DAMAGED)
@given(byte_hits(1, 3))
def test_a_damaged_file_is_refused_or_numbers(name, tmp_path_factory, hits):
    folder = tmp_path_factory.mktemp("log")
    (folder / f"run.{name}").write_bytes(hit(formatted(name), hits))
    read(source(folder, files=f"run.{name}", **FORMATS[name][1]))
