"""Learned terms beside true terms, directly and up to the factor P(q) of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.data import DataSource
from pinn_dyn.mechanics import MechanicalSystem, Predictor, Terms, double_copy


@dataclass(frozen=True)
class TermComparison:
    """True and learned terms at K named configurations.

    Attributes:
        names: K names of configurations.
        q: configurations, ``(K, N)``.
        true, learned: M, D, G, A of the true system and of the model.
        P: best-fit factor, ``(K, N, N)``, see :func:`fit_factor`.
        of_inverse_mass: the equations of the model, in (q, p), contain the inverse of M.
    """

    names: list[str]
    q: Tensor
    true: Terms
    learned: Terms
    P: Tensor
    of_inverse_mass: bool

    def matrices(self) -> dict[str, tuple[Tensor, Tensor, Tensor]]:
        """Return true X, learned X_L and P X for M, M_inverse, D, G and A.

        Each is ``(K, N, .)``, G with one column. The third matrix of M_inverse is (P M)^-1.
        """
        versions = {}
        for name, *pair in zip(Terms._fields, self.true, self.learned, strict=True):
            if pair[0].numel():  # no A without inputs
                true, learned = (x.reshape(*self.q.shape, -1) for x in pair)
                versions[name] = (true, learned, self.P @ true)
        mass = versions.pop("M")
        inverse = (_inverse(mass[0]), _inverse(mass[1]), _inverse(mass[2]))
        return {"M": mass, "M_inverse": inverse, **versions}

    def to_frame(self) -> pd.DataFrame:
        """Return one row per configuration and term, with Frobenius norms::

        relative_error_identity = |X_L - X| / |X|         (P = I)
        relative_error_best_P   = |X_L - P X| / |X_L|
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


def compare_terms(
    model: MechanicalSystem,
    truth: MechanicalSystem,
    q: Tensor,
    *,
    names: Sequence[str] | None = None,
) -> TermComparison:
    """Compare the terms of a learned model with the true terms, in float64.

    Args:
        model, truth: the learned and the true system, with the same N and M.
        q: configurations, ``(K, N)``.
        names: K names of the configurations; None numbers them.
    """
    q = q.double()
    labels = list(names) if names else [str(k + 1) for k in range(len(q))]
    with torch.no_grad():
        true, learned = (double_copy(system, q.device).terms(q) for system in (truth, model))
    return TermComparison(labels, q, true, learned, fit_factor(true, learned), model.state == "qp")


def compare_with_source(model: Predictor, source: DataSource) -> TermComparison | None:
    """Compare the terms of a mechanical model with those of a simulated robot; None for others."""
    names, system = list(source.configurations), source.system
    if system is None or not names or not isinstance(model, MechanicalSystem):
        return None
    q = torch.tensor([source.configurations[name] for name in names], dtype=torch.float64)
    return compare_terms(model, system, q, names=names)


def fit_factor(true: Terms, learned: Terms) -> Tensor:
    """Fit the factor P(q), ``(*batch, N, N)``, between learned and true terms::

        P = argmin  sum_X |P X - X_L|^2 / |X|^2,     X in {M, D, A, G}

    with Frobenius norms. A true term that vanishes is left out; where P is not unique, the P of
    smallest norm is returned. Motion determines the terms only up to such a P.

    Source: paper, section PINN-based controllers, X_L = P X. The column P(q) of the paper's table
    holds the inverse.
    """
    true, learned = (x._replace(G=x.G.unsqueeze(-1)) for x in (true, learned))
    norms = [torch.linalg.matrix_norm(X)[..., None, None] for X in true]
    weights = [torch.where(norm > 0, 1 / norm, 0.0) for norm in norms]
    X, X_L = (
        torch.cat([weight * x for weight, x in zip(weights, terms, strict=True)], -1)
        for terms in (true, learned)
    )
    return X_L @ torch.linalg.pinv(X)


def term_conditions(model: MechanicalSystem, q: Tensor) -> pd.DataFrame:
    """Return the conditioning of the terms of a model at configurations q ``(K, N)``, a row each.

    Next to ``q1`` to ``qN`` there are ``mass_min`` and ``damping_min``, the smallest eigenvalues of
    M and D, and ``mass_condition`` and ``input_condition``, condition numbers in the 2-norm.
    """
    with torch.no_grad():
        terms = double_copy(model, q.device).terms(q.double())
    columns = {f"q{i + 1}": value for i, value in enumerate(q.unbind(-1))} | {
        "mass_min": torch.linalg.eigvalsh(terms.M)[..., 0],
        "damping_min": torch.linalg.eigvalsh(0.5 * (terms.D + terms.D.mT))[..., 0],
        "mass_condition": torch.linalg.cond(terms.M),
        "input_condition": torch.linalg.cond(terms.A),
    }
    return pd.DataFrame({name: value.cpu().numpy() for name, value in columns.items()})


def _inverse(matrix: Tensor) -> Tensor:
    inverse, info = torch.linalg.inv_ex(matrix)
    return torch.where((info > 0)[..., None, None], torch.inf, inverse)


def _relative(difference: Tensor, reference: Tensor) -> Tensor:
    size = torch.linalg.matrix_norm(difference)
    return torch.where(size > 0, size / torch.linalg.matrix_norm(reference), 0.0)
