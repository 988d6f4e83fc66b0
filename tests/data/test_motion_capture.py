"""Exports of Motive, Nexus and QTM: the columns of markers by name, in the units of the file."""

import numpy as np
import pytest

from pinn_dyn.data.logs import LogError, LogSource
from pinn_dyn.data.logs.readers import read_tables
from pinn_dyn.data.logs.table import Request

RATE, COUNT = 100, 400
T = np.arange(COUNT) / RATE
TIP = np.stack([np.sin(T), np.cos(1.3 * T), 0.5 * np.sin(0.7 * T)], axis=1)  # m
BASE = 0.1 * TIP + 1.0


def table(rows):
    return "\n".join(",".join(map(str, row)) for row in rows) + "\n"


def motive(parent=False):
    """A rigid body and two markers; Motive 3 has a row of parents."""
    owners = ["arm"] * 8 + ["arm:tip"] * 3 + ["Unlabeled"] * 3 + ["Unlabeled"] * 3
    kinds = ["Rigid Body"] * 8 + ["Rigid Body Marker"] * 3 + ["Marker"] * 6
    quantities = ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"] + ["Position"] * 9
    axes = [*"XYZW", *"XYZ", "", *"XYZ" * 3]
    head = "Format Version,1.23,Take Name,Take 1,Export Frame Rate,100.000000,Rotation Type,"
    head += "Quaternion,Length Units,Millimeters,Coordinate Space,Global\n\n"
    rows = [["", "Type", *kinds], ["", "Name", *owners], ["", "ID", *["5C:1"] * 17]]
    rows += [["", "Parent", *["arm"] * 17]] if parent else []
    rows += [["", "", *quantities], ["Frame", "Time (Seconds)", *axes]]
    ones = np.ones((COUNT, 1))
    data = [np.arange(COUNT)[:, None], T[:, None], 0 * BASE, ones, 1e3 * BASE, 0.1 * ones]
    data += [1e3 * TIP, 2e3 * TIP, 3e3 * TIP]
    return head + table(rows) + table(np.hstack(data).round(6).tolist())


def nexus(separator=","):
    """A section of devices at another rate, and one of markers with an occluded sample."""
    devices = "Devices\n1000\n,,Force Plate - Force,,\nFrame,Sub Frame,Fx,Fy,Fz\n,,N,N,N\n"
    devices += table([[1, k, 1.0, 2.0, 3.0] for k in range(50)])
    rows = [["", "", "arm:tip", "", "", "arm:base", "", ""], ["Frame", "Sub Frame", *"XYZXYZ"]]
    rows += [["", "", *["mm"] * 6]]
    values = np.hstack([1e3 * TIP, 1e3 * BASE]).round(6).tolist()
    values[7][:3] = ["", "", ""]
    rows += [[k + 1, 0, *row] for k, row in enumerate(values)]
    text = devices + "\nTrajectories\n100\n" + table(rows)
    return text.replace(",", separator)


def qtm(frames=True, names=True):
    """Tab-separated rows with or without frames and times, and with or without a header."""
    head = "NO_OF_FRAMES\t400\nNO_OF_MARKERS\t2\nFREQUENCY\t100\nDATA_INCLUDED\t3D\n"
    head += "MARKER_NAMES\ttip\tbase\nTRAJECTORY_TYPES\tMeasured\tMeasured\n"
    if names:
        columns = [f"{marker} {axis}" for marker in ("tip", "base") for axis in "XYZ"]
        head += "\t".join([*(["Frame", "Time"] if frames else []), *columns]) + "\n"
    data = [np.arange(COUNT)[:, None] + 1, T[:, None]] if frames else []
    data += [1e3 * TIP, 1e3 * BASE]
    return head + table(np.hstack(data).round(6).tolist()).replace(",", "\t")


FILES = {
    "Motive": (motive(), "arm:tip", "arm", "Time (Seconds)"),
    "Motive 3": (motive(parent=True), "arm:tip", "arm", "Time (Seconds)"),
    "Nexus": (nexus(), "arm:tip", "arm:base", ""),
    "QTM": (qtm(), "tip", "base", "Time"),
    "QTM without frames": (qtm(frames=False, names=False), "tip", "base", ""),
}


@pytest.mark.parametrize("name", FILES)
def test_markers_are_read_by_name(name, tmp_path):
    text, tip, base, time = FILES[name]
    (tmp_path / "take.csv").write_text(text, newline="")
    columns = [f"{marker}:{axis}" for marker in (tip, base) for axis in "XYZ"]
    clock = {"columns": time} if time else {"rate": RATE}
    source = LogSource(
        files="take.csv", root=str(tmp_path), time=clock, q={"columns": columns, "unit": "mm"}, u=[]
    )
    whole = np.concatenate([item.raw.q for item in source.cleaned])
    expected = np.hstack([TIP, BASE])
    for row in whole[::10]:
        near = np.abs(expected - row).max(axis=1).min()
        assert near < 2e-6 if "Nexus" not in name else 1e-3
    assert len(whole) > 300
    metres = LogSource(
        files="take.csv", root=str(tmp_path), time=clock, q={"columns": columns, "unit": "m"}, u=[]
    )
    metres.load()
    assert any("mm" in text for text in metres.warnings)


def test_rotations_and_equal_names_keep_their_columns(tmp_path):
    path = tmp_path / "take.csv"
    path.write_text(motive())
    (frame,) = read_tables(path, Request("Time (Seconds)", ["arm:tip:X"])).values()
    assert frame.column("arm:rotation W", "q").iloc[5] == 1
    assert frame.column("Unlabeled:X #2", "q").iloc[5] == pytest.approx(3e3 * TIP[5, 0])
    assert frame.place(0) == f"{path}, line 8"
    with pytest.raises(LogError, match=r"no column 'arm:tipp:X'.*did you mean arm:tip:X"):
        frame.column("arm:tipp:X", "q")


def test_the_section_with_the_columns_is_read(tmp_path):
    path = tmp_path / "take.csv"
    path.write_text(nexus())
    columns = ["Force Plate - Force:Fx"]
    (frame,) = read_tables(path, Request("", columns)).values()
    assert len(frame) == 50
    assert frame.column(columns[0], "u").eq(1.0).all()


def test_missing_frames_are_named_and_the_frames_give_the_time(tmp_path):
    """Vicon states its rate and numbers its frames, which rows do not count."""
    rows = [f"{k},0,{np.sin(0.01 * k)},{np.cos(0.01 * k)},0" for k in range(1, 400) if k != 200]
    head = ["Trajectories", "100", ",,arm:tip,,", "Frame,Sub Frame,X,Y,Z", ",,mm,mm,mm"]
    path = tmp_path / "run.csv"
    path.write_text("\n".join([*head, *rows]))
    (table,) = read_tables(path, Request("Time", ["Time", "arm:tip:X"])).values()
    assert table.frame["Time"].iloc[[0, 198, 199]].tolist() == pytest.approx([0, 1.98, 2.0])
    assert table.notes == [
        "1 frames are missing, the first after frame 199: time: {columns: Time} counts frames, not "
        "rows"
    ]
