"""Log files that are no log: each is refused with the file, the place and what was expected."""

import functools
import gzip
import time

import numpy as np
import pytest
from scipy.io import savemat

from pinn_dyn.data.logs import LogError
from tests.attacks.formats import MATRICES, formatted
from tests.data.logs_files import motion, source

ROW = 300


@functools.cache
def good():
    return motion(6.0).to_csv(index=False, float_format="%.9g")


def rows(change):
    """The good log with its lines changed in place."""
    lines = good().splitlines()
    change(lines)
    return "\n".join(lines) + "\n"


def cell(text, column=2):
    """The good log with one cell replaced: by default q1... in line 302 of the file."""

    def change(lines):
        cells = lines[ROW + 1].split(",")
        cells[column - 1] = text
        lines[ROW + 1] = ",".join(cells)

    return rows(change)


def column(values, name="t"):
    table = motion(6.0)
    table[name] = values(table[name].to_numpy())
    return table.to_csv(index=False, float_format="%.9g")


def refused(folder, message, **changes):
    start = time.perf_counter()
    with pytest.raises(LogError, match=message) as caught:
        source(folder, **changes).load()
    assert time.perf_counter() - start < 10
    assert len(str(caught.value)) < 900
    return str(caught.value)


FILES = {
    "empty": ("", "cannot be read as CSV"),
    "one newline": ("\n", "cannot be read as CSV|has no rows"),
    "newlines": ("\n" * 500, "cannot be read as CSV|has no rows"),
    "a header alone": (good().splitlines()[0], "has no rows"),
    "a header and blanks": (good().splitlines()[0] + "\n\n\n\n", "has no rows"),
    "one row": ("\n".join(good().splitlines()[:2]) + "\n", "at least two|too short|rows"),
    "two rows": ("\n".join(good().splitlines()[:3]) + "\n", "too short|rows"),
    "no header": ("\n".join(good().splitlines()[1:]) + "\n", "no column 't'"),
    "prose": ("Dear reader,\nthis is no log.\n", "no column 't'"),
    "html": ("<html><body>\n<p>404</p>\n</body></html>\n", "no column 't'"),
    "json": ('{"t": [0, 1],\n "q1": [0, 1]}\n', "no column 't'"),
    "zeros": (b"\0" * 5000, "has no rows"),
    "every byte": (bytes(range(256)) * 40, "cannot be read as CSV"),
    "utf-16": (good().encode("utf-16"), "cannot be read as CSV"),
    "latin-1": (good().replace("u2", "µ2").encode("latin-1"), "cannot be read as CSV"),
    "a picture": (b"\x89PNG\r\n\x1a\n" + bytes(2000), "cannot be read as CSV"),
    "a pickle": (b"cos\nsystem\n(S'touch was_here'\ntR.", "no column 't'|cannot be read as CSV"),
    "an open quote": (cell('"0.1'), "cannot be read as CSV|line 302|is empty or NaN"),
    "long rows": (rows(lambda x: x.__setitem__(ROW, x[ROW] + ",1")), "cannot be read as CSV"),
    "short rows": (rows(lambda x: x.__setitem__(ROW, "1,2")), "line 301, .* is empty or NaN"),
    "a blank row": (rows(lambda x: x.insert(ROW, "")), "line 301, column 't'.* is empty or NaN"),
    "a cut end": (good()[:-40].rsplit(",", 1)[0], "line .* is empty or NaN"),
    "two headers": (rows(lambda x: x.insert(ROW, x[0])), "line 301, column 't' .*the value is 't'"),
    "a comment": (rows(lambda x: x.insert(0, "# by my logger")), "no column 't'|cannot be read"),
    "units below": (rows(lambda x: x.insert(1, "s,rad,rad/s,Nm,rad,rad/s,Nm")), "line 2, col"),
    "two of a name": (good().replace("q2", "q1", 1), "2 columns have the name 'q1'"),
    "blanks around": (good().replace("q1", " Q1 ", 1), "no column 'q1'"),
    "one column": ("t\n" + "\n".join(str(k / 100) for k in range(600)), "no column 'q1'"),
    "semicolons": (good().replace(",", ";").replace(".", ","), "with a decimal comma"),
    "spaces": (good().replace(",", " "), "no column 't'"),
}  # fmt: skip


@pytest.mark.parametrize(("content", "message"), FILES.values(), ids=FILES)
def test_a_file_that_is_no_log(tmp_path, content, message):
    data = content if isinstance(content, bytes) else content.encode()
    (tmp_path / "run.csv").write_bytes(data)
    assert "run" in refused(tmp_path, message)


CELLS = [
    *("", "nan", "NaN", "NA", "null", "None", "-", "inf", "-inf", "1e400", "broken", "0x10"),
    *("1_0", "1 000", "1.2.3", "--1", "1e", "e5", "#REF!", "TRUE", "12:30:00", "2026-11-24"),
    *("=cmd|' /C calc'!A0", "=HYPERLINK(1)", "__import__('os').system('touch was_here')"),
    *("${jndi:ldap://localhost/x}", "{{7*7}}", "../../etc/passwd", "\u0661\u0662x", "½", "−1"),
]


@pytest.mark.parametrize("text", CELLS)
def test_a_cell_that_is_no_number(tmp_path, text):
    (tmp_path / "run.csv").write_text(cell(text), encoding="utf-8")
    said = refused(tmp_path, r"run.csv, line 302, column 'q1' \(q\): the value is .*expected a num")
    assert "1 such rows in this column" in said


TIMES = {
    "constant": (lambda t: 0 * t, "repeats"),
    "backwards": (lambda t: -t, "goes back from -?0 to -0.01"),
    "milliseconds": (lambda t: 1000 * t, "unit of the time wrong"),
    "nanoseconds": (lambda t: 1e9 * t + 1.7e18, "unit of the time wrong|repeats|sample time"),
    "microseconds": (lambda t: 1e-6 * t, "unit of the time wrong|sample time"),
    "starts again": (lambda t: np.where(t > 3, t - 3, t), "line 303.*goes back from 3 to 0.01"),
    "a gap": (lambda t: np.where(t > 3, t + 9, t), "line 303.*jumps from 3 to 12.01"),
    "a repeat": (lambda t: np.where(np.isclose(t, 3), 2.99, t), "line 302.*2.99 s repeats"),
    "jitter": (lambda t: t + 0.004 * np.sin(40 * t), "needs a uniform clock"),
    "endless": (lambda t: np.where(t > 3, np.inf, t), "line 303, column 't' .*expected a number"),
    "1e300": (lambda t: np.where(t > 3, 1e300, t), r"line 304.*the time 1e\+300 s repeats"),
}


@pytest.mark.parametrize(("change", "message"), TIMES.values(), ids=TIMES)
def test_a_clock_that_is_none(tmp_path, change, message):
    (tmp_path / "run.csv").write_text(column(change))
    refused(tmp_path, message)


DESCRIPTIONS = {
    "a root that is a file": (dict(root="run.csv"), "which is no folder"),
    "a root of NUL": (dict(root="a\0b"), "which is no folder"),
    "an absolute file": (dict(files="/etc/passwd"), "expected paths from the folder root"),
    "a file outside": (dict(files="../*.csv"), "expected paths .*folder"),
    "nothing": (dict(files="*.txt"), "nothing matches"),
    "an empty pattern": (dict(files=""), "files"),
    "no patterns": (dict(files=[]), "files"),
    "a folder": (dict(files="folder"), "nothing matches"),
    "an unknown clock": (dict(time=dict(columns="time", unit="s")), "no column 'time'"),
    "a column of prose": (dict(trajectory="q9"), "no column 'q9'"),
    "no coordinates": (dict(q=dict(columns=[], unit="rad")), "q"),
    "an unknown unit": (dict(q=dict(columns=["q1"], unit="furlong")), "unit is 'furlong'"),
    "a scale of NaN": (dict(q=dict(columns=["q1"], unit="rad", scale=float("nan"))), "scale"),
    "a scale of zero": (dict(q=dict(columns=["q1"], unit="rad", scale=0.0)), "scale"),
    "a test of nothing": (dict(test=dict(seconds=0.0, piece=0.5)), "expected more than 0"),
    "a test of NaN": (dict(test=dict(seconds=float("nan"), piece=0.5)), "expected"),
    "a piece of NaN": (dict(test=dict(seconds=1.0, piece=float("nan"))), "piece is nan"),
    "a test of all": (dict(test=dict(seconds=100.0, piece=0.5)), "too short to keep 100"),
    "a guard of all": (dict(guard=100.0), "too short|guard"),
    "a guard of NaN": (dict(guard=float("nan")), "guard is nan"),
    "an unknown run": (dict(test=dict(runs=["../run"], piece=0.5)), r"no run '\.\./run'"),
}


@pytest.mark.parametrize(("changes", "message"), DESCRIPTIONS.values(), ids=DESCRIPTIONS)
def test_a_description_that_fits_no_log(tmp_path, changes, message):
    folder = tmp_path / "logs"
    (folder / "folder").mkdir(parents=True)
    (folder / "run.csv").write_text(good())
    (tmp_path / "outside.csv").write_text(good())
    refused(folder, message, **changes)


COMPRESSED = {
    "no gzip": (b"t,q1\n1,2\n", "cannot be read as CSV"),
    "cut": (gzip.compress(good().encode())[:5000], "cannot be read as CSV"),
    "damaged": (gzip.compress(good().encode())[:3000] + bytes(3000), "cannot be read as CSV"),
    "empty": (b"", "cannot be read as CSV"),
    "twice": (gzip.compress(gzip.compress(good().encode())), "cannot be read as CSV"),
}


@pytest.mark.parametrize(("content", "message"), COMPRESSED.values(), ids=COMPRESSED)
def test_a_compressed_file_that_is_none(tmp_path, content, message):
    (tmp_path / "run.csv.gz").write_bytes(content)
    refused(tmp_path, message, files="*.gz")


def mat(**changes):
    table = motion(6.0)
    log = {
        "t": table[["t"]].to_numpy(),
        "q": table[["q1"]].to_numpy(),
        "u": table[["u1"]].to_numpy(),
    }
    return {name: x for name, x in {**log, **changes}.items() if x is not None}


MATLAB = {
    "no time": (mat(t=None), "no variable 't' for the time"),
    "complex": (mat(q=np.ones((601, 1)) * 1j), "holds complex numbers"),
    "complex time": (mat(t=np.ones((601, 1)) * 1j), r"variable 't' \(time\): holds complex"),
    "ragged": (mat(q=np.array([[np.ones(3), np.ones(4)]], dtype=object)), "is a cell array"),
    "a text": (mat(q="hello"), "is a text"),
    "short": (mat(q=np.ones((600, 1))), "is 600 by 1, and the time has 601 samples"),
    "cube": (mat(q=np.ones((601, 1, 2))), "has 3 dimensions"),
    "nan": (mat(q=np.full((601, 1), np.nan)), "is empty or NaN"),
    "empty": (mat(q=np.ones((0, 0))), "is 0 by 0|no column 'q'"),
}


@pytest.mark.parametrize(("content", "message"), MATLAB.values(), ids=MATLAB)
def test_a_matlab_file_without_the_signals(tmp_path, content, message):
    savemat(tmp_path / "run.mat", content)
    columns = dict(q=dict(columns=["q"], unit="rad"), u=dict(columns=["u"], unit="Nm"), v=None)
    refused(tmp_path, message, files="*.mat", **columns)


@pytest.mark.parametrize(
    "content",
    [b"", b"hello", bytes(200), b"MATLAB 7.3 MAT-file" + bytes(600), bytes(range(256)) * 8],
    ids=["empty", "text", "zeros", "7.3", "bytes"],
)
def test_a_file_that_is_no_matlab_file(tmp_path, content):
    (tmp_path / "run.mat").write_bytes(content)
    refused(tmp_path, "cannot be read as a MATLAB file|MATLAB 7.3", files="*.mat")


@pytest.mark.parametrize("kind", [0, 8, 14, 15, 19, 255])
def test_an_element_of_a_matlab_file_of_no_type(tmp_path, kind):
    """SciPy itself ends the process on it, without a word."""
    content = bytearray(formatted("mat"))
    place = content.index(b"\x09\0\0\0")  # the first array's numbers
    content[place : place + 4] = kind.to_bytes(4, "little")
    (tmp_path / "run.mat").write_bytes(content)
    with pytest.raises(LogError, match=f"run.mat: cannot be read .* element of type {kind} "):
        source(tmp_path, files="run.mat", **MATRICES).load()
