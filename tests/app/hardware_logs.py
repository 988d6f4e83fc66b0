"""Stand-ins for the logs of the paper's hardware: its columns and rates, sines for a motion."""

from tests.data.logs_files import motion, write


def write_neck(folder):
    """Tip angles and four motors at 10 Hz; returns where the log is, as overrides."""
    table = motion(300.0, rate=10.0)
    table["u3"], table["u4"] = -table["u1"], -table["u2"]
    write(folder, table.drop(columns=["v1", "v2"]), "neck.csv")
    return [f"dataset.root='{folder}'", "dataset.files=neck.csv"]


def write_panda(folder):
    """Seven joints at 500 Hz; returns where the log is, as overrides."""
    table = motion(15.0, rate=500.0)[["t"]]
    for k in range(7):
        joint = motion(15.0, phase=k, rate=500.0)
        table[f"q{k + 1}"], table[f"qd{k + 1}"] = joint["q1"], joint["v1"]
        table[f"tau{k + 1}"] = joint["u1"]
    write(folder, table, "panda.csv")
    return [f"dataset.root='{folder}'", "dataset.files='*.csv'"]
