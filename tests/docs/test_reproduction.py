"""results/reproduction.yaml: the paper's errors are the paper's, and what it names exists."""

import shlex

import pytest
import torch
import yaml

from pinn_dyn.evaluation.learned_terms import fit_factor
from pinn_dyn.mechanics import Terms
from pinn_dyn.systems import SoftArm
from reproduce import ENTRIES, read_entries
from tests.docs.commands import check_python

SLOW = pytest.mark.slow
Q = {"strongly_bent": [1.2, -0.2, 0.15], "bent": [0.8, 0.2, 0.3]}
# The matrices that the paper prints.
LEARNED = {
    "hnn": {
        "strongly_bent": {
            "M_inverse": "600.32 16.90 15.67  16.90 622.92 -1.34  15.67 -1.34 11.61",
            "D": "1.02e-1 3.44e-3 8.12e-5  3.44e-3 1.05e-1 -4.39e-4  8.12e-5 -4.39e-4 9.91e-2",
            "G": "1.33 -0.18 -1.15",
            "A": "-0.06 -0.94 0.05  0.83 0.02 -0.04  0.0 0.01 0.78",
        },
        "bent": {
            "M_inverse": "285.01 11.08 6.65  11.08 292.46 2.06  6.65 2.06 10.59",
            "D": "1.01e-1 3.48e-3 6.56e-4  3.48e-3 1.03e-1 -7.45e-5  6.56e-4 -7.45e-5 9.87e-2",
            "G": "0.93 0.25 -1.10",
            "A": "0.03 -0.96 0.05  0.92 -0.03 -0.02  -0.01 0.0 0.89",
        },
    },
    "lnn": {
        "strongly_bent": {
            "M": "4.23e-3 1.20e-3 -0.03  1.20e-3 5.99e-3 -0.02  -0.03 -0.02 0.59",
            "D": "0.16 -0.02 0.0  -0.02 0.33 -0.01  0.0 -0.01 0.35",
            "G": "2.44 -0.61 -5.25",
            "A": "0.12 -1.72 -0.21  3.05 -0.19 -0.13  -0.34 1.01 3.40",
        },
        "bent": {
            "M": "6.93e-3 1.84e-3 -0.03  1.84e-3 0.01 -0.02  -0.03 -0.02 0.50",
            "D": "0.17 -0.01 0.0  -0.01 0.33 -0.01  0.0 -0.01 0.35",
            "G": "1.62 0.81 -4.67",
            "A": "0.19 -1.66 -0.20  2.97 -0.25 -0.13  -0.40 1.01 3.43",
        },
    },
}


def printed(text):
    numbers = torch.tensor([float(word) for word in text.split()], dtype=torch.float64)
    return numbers if len(numbers) == 3 else numbers.reshape(3, 3)


@pytest.mark.parametrize("configuration", Q)
@pytest.mark.parametrize("model", LEARNED)
def test_the_papers_errors_follow_from_the_matrices_that_it_prints(model, configuration):
    q = torch.tensor(Q[configuration], dtype=torch.float64)
    true = SoftArm(segments=1).double().terms(q)
    entry = yaml.safe_load(ENTRIES.read_text())["terms"][model]
    learned = {term: printed(LEARNED[model][configuration][term]) for term in entry["terms"]}
    P = torch.eye(3, dtype=torch.float64)
    if model == "lnn":
        P = fit_factor(true, Terms(**learned))
    values = true._asdict() | {"M_inverse": torch.linalg.inv(true.M)}
    for term, expected in zip(entry["terms"], entry["paper"][configuration], strict=True):
        near = P @ values[term]
        reference = learned[term] if model == "lnn" else near
        error = 100 * (learned[term] - near).norm() / reference.norm()
        assert float(error) == pytest.approx(expected, abs=0.051), term


@pytest.mark.parametrize("part", [slice(None, None, 5), pytest.param(slice(None), marks=SLOW)])
def test_the_commands_of_the_entries_compose(tmp_path, part):
    """Every fifth of them, all with make test-slow."""
    earlier = set()
    commands = set()
    for name, entry in read_entries().items():
        trainings = entry.get("train", [])
        for train in [trainings] if isinstance(trainings, str) else trainings:
            words = [word for word in shlex.split(train) if not word.startswith("seed=")]
            commands.add(("train.py", "-m", *words))
        for program, run in (("evaluate", "runs=[x]"), ("control", "run=x")):
            if program in entry:
                commands.add((f"{program}.py", run, *shlex.split(entry[program])))
        assert set(entry.get("runs", ())) <= earlier, name
        earlier.add(name)
    assert len(commands) > 50
    for words in sorted(commands)[part]:
        check_python([*words], tmp_path)
