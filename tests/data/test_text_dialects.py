"""Text files of many dialects give the recording that a plain CSV file gives."""

import io
import re

import numpy as np
import pytest
import torch

from pinn_dyn.data.logs import LogError
from tests.data.logs_files import motion, named, source

TABLE = motion(6.0).round(9)
NAMES = TABLE.columns.tolist()
ROWS = TABLE.to_numpy().tolist()
UNITS = ["s", "rad", "rad/s", "Nm", "rad", "rad/s", "Nm"]
PLAIN = "\n".join(",".join(map(repr, row)) for row in ROWS) + "\n"
HEADER = ",".join(NAMES) + "\n"
CSV = HEADER + PLAIN


def german(text):
    return text.replace(",", ";").replace(".", ",")


def saved(**options):
    file = io.StringIO()
    np.savetxt(file, ROWS, fmt="%.17g", **options)
    return file.getvalue()


def each_line(text, change):
    return "".join(change(k, line) for k, line in enumerate(text.splitlines(keepends=True)))


def vectors(opening, closing, inside, sep=","):
    rows = [
        [repr(t), *(f"{opening}{row[k]!r}{inside}{row[k + 3]!r}{closing}" for k in range(3))]
        for t, *row in ROWS
    ]
    return "\n".join(map(sep.join, [["t", "q", "v", "u"], *rows]))


def by_number(start, names=NAMES):
    """Columns of the source whose names are numbers."""
    place = {name: str(start + k) for k, name in enumerate(names)}
    return dict(
        time=dict(columns=place["t"], unit="s"),
        q=dict(columns=[place["q1"], place["q2"]], unit="rad"),
        v=dict(columns=[place["v1"], place["v2"]], unit="rad/s"),
        u=dict(columns=[place["u1"], place["u2"]], unit="Nm"),
    )


VECTORS = named("{}_{}")
LABVIEW = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDate\t2026/11/20\n"
    "***End_of_Header***\t\n\t\nChannels\t6\t\t\t\t\t\t\nSamples\t601\t601\t601\t601\t601\t601\t\n"
    "X0\t0.0E+0\t0.0E+0\t0.0E+0\t0.0E+0\t0.0E+0\t0.0E+0\t\nDelta_X\t0.01\t0.01\t0.01\t0.01\t"
    "0.01\t0.01\t\n***End_of_Header***\t\t\t\t\t\t\t\n"
)
DIALECTS = {
    "semicolons": CSV.replace(",", ";"),
    "bars": CSV.replace(",", "|"),
    "tabs": CSV.replace(",", "\t"),
    "blanks": CSV.replace(",", " "),
    "comma and blank": CSV.replace(",", ", "),
    "header with commas, rows with blanks": HEADER + PLAIN.replace(",", " "),
    "header with blanks, rows with commas": HEADER.replace(",", " ") + PLAIN,
    "German": german(CSV),
    "German with tabs": german(CSV).replace(";", "\t"),
    "German, exponents": german(CSV.replace("e-0", "E-0")),
    "sep": "sep=;\n" + german(CSV),
    "BOM": CSV.encode("utf-8-sig"),
    "UTF-16": CSV.encode("utf-16"),
    "UTF-16 big-endian": b"\xfe\xff" + german(CSV).encode("utf-16-be"),
    "CRLF": CSV.replace("\n", "\r\n"),
    "old Mac": CSV.replace("\n", "\r"),
    "savetxt": saved(header=" ".join(NAMES)),
    "savetxt, blanks above commas": saved(header=" ".join(NAMES), delimiter=","),
    "MATLAB comment": "% " + HEADER + PLAIN.replace(",", "   "),
    "free text": "Robot, arm of the lab\nDate: 2026-11-20 12:00, C:\\Users\\me\n\n" + CSV,
    "comment below": HEADER + "// recorded by me, in the lab\n" + PLAIN,
    "comment inside": CSV[: CSV.index("\n2.0,")] + "\n# pause, 3 s, 5, 6, 7, 8, 9" * 2
    + CSV[CSV.index("\n2.0,") :],
    "units": HEADER + ",".join(UNITS) + "\n" + PLAIN,
    "quotes": ",".join(f'"{x}"' for x in NAMES) + "\n" + each_line(
        PLAIN, lambda k, x: '"' + x[:-1].replace(",", '","') + '"\n'),
    "trailing commas": HEADER + PLAIN.replace("\n", ",\n"),
    "trailing semicolons, German": german(CSV).replace("\n", ";\n"),
    "empty first line": "\n" + CSV,
    "index": each_line(CSV, lambda k, x: f'"{k or ""}",{x}'),
    "text column": each_line(CSV, lambda k, x: x[:-1] + (",state\n", ",moving arm\n")[k > 0]),
    "half of a column empty": each_line(
        CSV, lambda k, x: x[:-1] + (f",{3 * (k % 2) or ''}\n" if k else ",n\n")),
    "dates": each_line(
        CSV, lambda k, x: (f"2026-11-20 12:00:00.{k}," if k else "stamp,") + x),
    "dates with points": each_line(
        CSV, lambda k, x: (f"2026-11-20 12.00.{k}," if k else "stamp,") + x),
    "German dates": each_line(
        german(CSV), lambda k, x: (f"20.11.2026 12:00:00,{k};" if k else "stamp;") + x),
    "LabVIEW": LABVIEW + (HEADER.replace("\n", ",Comment\n") + PLAIN).replace(",", "\t"),
}  # fmt: skip
OTHER_COLUMNS = {
    "no header": (PLAIN, by_number(0)),
    "no header, German": (german(PLAIN), by_number(0)),
    "pandas without names": (",".join("0123456") + "\n" + PLAIN, by_number(0)),
    "MATLAB, save -ascii": (saved(), by_number(0)),
    "lists": (vectors('"[', ']"', ", "), VECTORS),
    "arrays": (vectors("[", "]", " "), VECTORS),
    "index without a name": (CSV[1:], {"time": dict(columns="index", unit="s")}),
    "names that are numbers": (
        "No.,1,2,3,4,5,6\n" + each_line(PLAIN, lambda _, x: f"2026-11-20 12:00:0{x}"),
        by_number(0) | {"time": dict(columns="No.", unit="s")},
    ),
    "time beside each column, settings below the header": (
        "\t".join(f"Name\t{x}" for x in NAMES[1:]) + "\n"
        + "\t".join(["SampleTime[ms]\t10"] * 6) + "\n"
        + "".join("\t".join(f"{t!r}\t{x!r}" for x in row) + "\n" for t, *row in ROWS),
        {"time": dict(columns="Name", unit="s")},
    ),
    "lists, semicolons": (vectors("[", "]", ", ", ";"), VECTORS),
    "units of each name": (
        german(" ;".join(["t", *(f"{x} [{u}]" for x, u in zip(NAMES[1:], UNITS[1:], strict=True))]))
        + "\n" + german(PLAIN),
        {key: dict(part, columns=[f"{x} [{part['unit']}]" for x in part["columns"]])
         for key, part in named("{}{}").items()},
    ),
    "rostopic echo -p": (
        CSV.replace("t,", "%time,", 1), {"time": dict(columns="%time", unit="s")}),
    "Windows-1252": (
        CSV.replace("q1", "Gelenk 1 [°]").replace("q2", "Gelenk 2 [°]").encode("cp1252"),
        {"q": dict(columns=["Gelenk 1 [°]", "Gelenk 2 [°]"], unit="deg", scale=180 / np.pi)},
    ),
}  # fmt: skip
ALL = {key: (text, {}) for key, text in DIALECTS.items()} | OTHER_COLUMNS


def loaded(folder, text, **changes):
    content = text if isinstance(text, bytes) else text.encode()
    (folder / "run.csv").write_bytes(content)
    log = source(folder, **changes)
    return log, [part.raw for part in (log.load(), log.cleaned)[1]]


def test_the_same_numbers_in_any_dialect(tmp_path):
    for dialect, (text, columns) in ALL.items():
        log, raws = loaded(tmp_path, text, **columns)
        assert log.warnings == [], dialect
        assert sum(map(len, raws)) > 500, dialect
        for raw in raws:
            rows = np.rint(raw.t * 100).astype(int)
            for name in "qvu":
                expected = TABLE[[f"{name}1", f"{name}2"]].to_numpy()[rows]
                found = getattr(raw, name)
                np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12, err_msg=dialect)


def spoiled(change):
    """The plain file with a change of its lines, a list with the header first."""
    lines = CSV.splitlines()
    change(lines)
    return "\n".join(lines) + "\n"


DROPPED = {
    "cut short": (CSV[: CSV.rindex(",")], "1 lines from line 602 on are dropped", 600),
    "footer": (
        CSV + "\nTotal: 601 rows\nend of file\n",
        "3 lines from line 603 on are dropped",
        601,
    ),
    "restarted": (
        spoiled(lambda x: x.insert(300, HEADER.strip())),
        "1 lines that repeat the header",
        601,
    ),
}


@pytest.mark.parametrize(("text", "note", "rows"), DROPPED.values(), ids=DROPPED)
def test_lines_that_hold_no_row_are_dropped_with_a_note(tmp_path, text, note, rows):
    log, _ = loaded(tmp_path, text)
    (warning,) = log.warnings
    assert note in warning
    assert f"{rows} rows" in log.report


def test_rows_that_a_user_comments_out_are_no_rows(tmp_path):
    log, _ = loaded(tmp_path, spoiled(lambda x: x.insert(300, "# " + x[300])))
    assert log.warnings == []
    assert "601 rows" in log.report


BAD = {
    "thousands": (
        spoiled(lambda x: x.__setitem__(9, '0.08,"1,234.5",,,,,')),
        "line 10.*1,234",
    ),
    "thousands in each row": (
        "t,q1,v1,u1,q2,v2,u2\n"
        + "".join(
            f'{k / 100},"{1000 + k:,.3f}",{",".join(map(repr, x[2:]))}\n'
            for k, x in enumerate(ROWS)
        ),
        r"'q1' \(q\): the value is '1,000.000'",
    ),
    "one column": ("q1\n0,1\n0,2\n", "2 cells, but the header in line 1 has 1 names"),
    "commas for both": (HEADER + PLAIN.replace(".", ","), "line 2: 14 cells.*header.*7 names"),
    "no header": (PLAIN, "no column 'q1'.*no header.* 0, 1, 2"),
    "unit in the name": (CSV.replace("q1", "'Q1 [rad]'"), r"'q1'.*did you mean 'Q1 \[rad\]'\?"),
    "long row": (spoiled(lambda x: x.__setitem__(500, x[500] + ",5")), "line 501"),
}


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD)
def test_what_cannot_be_read_is_refused_by_its_line(tmp_path, text, message):
    with pytest.raises(LogError, match=message):
        loaded(tmp_path, text)


@pytest.mark.parametrize(
    ("units", "columns", "warns"),
    [
        (["s", "[deg]", "deg/s", "Nm", "°", "°/s", "N*m"], ["q1", "v1", "q2", "v2"], True),
        (["sec", "rad", "rad/sec", "N.m", "Radian", "rad / s", "N m"], [], False),
        (["ms", "rad", "rad/s", "mNm", "rad", "rad/s", "Nm"], ["t", "u1"], True),
        (["s", "raw", "1/s", "(N)", "-", "", "counts"], [], False),
    ],
)
def test_units_of_the_file_are_compared(tmp_path, units, columns, warns):
    log, _ = loaded(tmp_path, HEADER + ",".join(units) + "\n" + PLAIN)
    texts = [x for x in log.warnings if "by the header" in x]
    assert [re.search(r"column '(\w+)'", x)[1] for x in sorted(texts)] == sorted(columns)
    assert bool(texts) == warns


def test_a_unit_in_a_name_is_compared_and_an_index_is_none(tmp_path):
    text = CSV.replace("q1", "q1 (deg)").replace("q2", "q(2)").replace("u1", "u (m)")
    q = dict(columns=["q1 (deg)", "q(2)"], unit="rad")
    u = dict(columns=["u (m)", "u2"], unit="Nm")
    log, _ = loaded(tmp_path, text, q=q, u=u)
    (warning,) = log.warnings
    assert "'q1 (deg)' (q) is in deg" in warning
    advice = dict(q, unit=[re.search(r"write unit: (\w+)", warning)[1], "rad"])
    assert loaded(tmp_path, text, q=advice, u=u, v=None)[0].warnings == []


def test_the_separator_may_be_named(tmp_path):
    """Each row is one comma short of being read as numbers with decimal points."""
    text = "t;q1;v1;u1;q2;v2;u2\n" + PLAIN.replace(",", ";")
    assert loaded(tmp_path, text, sep=";")[0].warnings == []
    with pytest.raises(LogError):
        loaded(tmp_path, text, sep=",")


def test_python_objects_are_refused_and_the_advice_works(tmp_path):
    t, q, u = (TABLE[x].to_numpy() for x in ("t", ["q1", "q2"], ["u1", "u2"]))
    torch.save({"t": np.poly1d([1.0]), "x": LogError}, tmp_path / "run.pt")
    log = source(tmp_path, files="run.pt", **{**VECTORS, "v": None})
    with pytest.raises(LogError, match="Python objects") as error:
        log.load()
    advice = re.search(r"torch\.save\(.*\)", str(error.value))[0]
    t, q, u = map(torch.tensor, (t, q, u))
    exec(advice, {"torch": torch, "path": tmp_path / "run.pt", "t": t, "q": q, "u": u})
    assert log.load().train
