"""Learned terms against true ones, directly and up to the factor P(q) of the paper."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.control.factor import fit_factor
from pinn_dyn.control.stability import require_same_robot, require_samples
from pinn_dyn.mechanics import MechanicalSystem, Terms, double_copy


@dataclass(frozen=True)
class TermComparison:
    """True and learned terms at K named configurations.

    Attributes:
        names: K names of configurations.
        q: configurations, ``(K, N)``.
        true: M, D, G, A of the true system.
        learned: M, D, G, A of the model.
        P: best-fit factor, ``(K, N, N)``, see
            :func:`pinn_dyn.control.factor.fit_factor`.
        P_min_eigenvalue: smallest eigenvalue of (P + P^T) / 2, ``(K,)``; the paper's controllers
            are proven for a positive one.
        of_inverse_mass: whether the equations of the model, in (q, p), are in the inverse of M.
    """

    names: list[str]
    q: Tensor
    true: Terms
    learned: Terms
    P: Tensor
    P_min_eigenvalue: Tensor
    of_inverse_mass: bool

    def matrices(self) -> dict[str, tuple[Tensor, Tensor, Tensor]]:
        """For M, M_inverse, D, G and A: the true term X, the learned X_L, and P X.

        Each ``(K, N, .)``, G as one column. For M_inverse the third is (P M)^-1.
        """
        true, learned = _as_matrices(self.true), _as_matrices(self.learned)
        pairs = {name: (true[name], learned[name], self.P @ true[name]) for name in true}
        mass = pairs.pop("M")
        inverse = (_inverse(mass[0]), _inverse(mass[1]), _inverse(mass[2]))
        return {"M": mass, "M_inverse": inverse, **pairs}

    def to_frame(self) -> pd.DataFrame:
        """One row per configuration and term, with Frobenius norms::

        relative_error_identity = |X_L - X| / |X|         (P = I)
        relative_error_best_P   = |X_L - P X| / |X_L|

        An error is 0 where both terms vanish and infinite where only the reference does.
        """
        errors = {
            term: (_relative(learned - true, true), _relative(learned - fitted, learned))
            for term, (true, learned, fitted) in self.matrices().items()
        }
        rows = [
            (name, term, float(identity[index]), float(best[index]))
            for index, name in enumerate(self.names)
            for term, (identity, best) in errors.items()
        ]
        columns = ["configuration", "term", "relative_error_identity", "relative_error_best_P"]
        return pd.DataFrame(rows, columns=columns)

    def to_text(self) -> str:
        """True and learned matrices side by side, as in the paper's tables, then P."""
        frame = self.to_frame()
        errors = iter(zip(frame.relative_error_identity, frame.relative_error_best_P, strict=True))
        lines = []
        for index, name in enumerate(self.names):
            lines += [f"configuration {name}", f"q = {_numbers(self.q[index])}", ""]
            for term, (true, learned, _) in self.matrices().items():
                identity, best = next(errors)
                left, right = _rows(true[index]), _rows(learned[index])
                width = max(len(left[0]), len(f"{term} true"))
                lines.append(
                    f"  {f'{term} true':<{width}}   {term} learned   "
                    f"(relative error {identity:.2g}, with the best P {best:.2g})"
                )
                lines += [f"  {a:<{width}}   {b}" for a, b in zip(left, right, strict=True)]
                lines.append("")
            smallest = float(self.P_min_eigenvalue[index])
            verdict = "positive definite" if smallest > 0 else "NOT positive definite"
            lines.append(
                f"  P, the best fit of learned = P true (symmetric part {verdict}: "
                f"smallest eigenvalue {smallest:.3g})"
            )
            lines += [f"  {row}" for row in _rows(self.P[index])] + [""]
        return "\n".join(lines)


def compare_terms(
    model: MechanicalSystem, truth: MechanicalSystem, q: Tensor, *, names: list[str] | None = None
) -> TermComparison:
    """Compare the terms of a learned model with the true ones, in float64.

    Args:
        model: the learned system.
        truth: the true system, with the same N and M.
        q: configurations, ``(K, N)``.
        names: one name per configuration; None counts them "1", "2", ...

    Raises:
        TypeError: if the model has no terms, as a black box has none.
        ValueError: if the systems, ``q`` and ``names`` do not match in size.
    """
    require_same_robot(model, truth)
    q = require_samples("q", q, truth)
    if names is None:
        names = [str(index + 1) for index in range(q.shape[0])]
    if len(names) != q.shape[0]:
        raise ValueError(f"names has {len(names)} entries, expected {q.shape[0]}, one per row of q")
    with torch.no_grad():
        true = double_copy(truth, q.device).terms(q)
        learned = double_copy(model, q.device).terms(q)
    P = fit_factor(true, learned)
    smallest = torch.linalg.eigvalsh(0.5 * (P + P.transpose(-1, -2)))[..., 0]
    return TermComparison(names, q, true, learned, P, smallest, model.state == "qp")


def _as_matrices(terms: Terms) -> dict[str, Tensor]:
    return terms._asdict() | {"G": terms.G.unsqueeze(-1)}


def _inverse(matrix: Tensor) -> Tensor:
    """The inverse, infinite where there is none."""
    inverse, info = torch.linalg.inv_ex(matrix)
    return torch.where((info > 0)[..., None, None], torch.inf, inverse)


def _relative(difference: Tensor, reference: Tensor) -> Tensor:
    size = torch.linalg.matrix_norm(difference)
    return torch.where(size > 0, size / torch.linalg.matrix_norm(reference), 0.0)


def _rows(matrix: Tensor) -> list[str]:
    """The rows of a matrix as text of one width, three significant digits."""
    # What is far below the largest entry is rounding, and prints as 0.
    clean = torch.where(matrix.abs() < 1e-9 * matrix.abs().max(), 0.0, matrix)
    cells = [[f"{value:.3g}" for value in row] for row in clean.tolist()]
    width = max(len(cell) for row in cells for cell in row)
    return ["[" + "  ".join(f"{cell:>{width}}" for cell in row) + "]" for row in cells]


def _numbers(vector: Tensor) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in vector.tolist()) + ")"
