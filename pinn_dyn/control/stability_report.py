"""Stability in plain words: Markdown reports, and what a model without a known truth allows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.control.stability import (
    StabilityCertificate,
    per_configuration,
    require_samples,
    require_system,
)
from pinn_dyn.control.steady_state import MARGIN, SPHERE_POINTS, SteadyState
from pinn_dyn.mechanics import MechanicalSystem, double_copy

MEASUREMENT_TOLERANCE = 1e-6
"""A measured error counts as above its bound beyond this, for the finite end of a simulation."""


@dataclass(frozen=True)
class ModelCheck:
    """What can be said of a learned model alone, at K configurations, ``(K,)`` each.

    Attributes:
        region: name of the region.
        q: configurations, ``(K, N)``.
        mass_eigenvalue, mass_condition: smallest eigenvalue and condition number of M_L.
        damping_eigenvalue: smallest eigenvalue of D_L.
        input_singular_value, input_condition: smallest singular value and condition number of
            A_L, which the law inverts.
        fully_actuated: whether N = M, as Proposition 1 needs.
    """

    region: str
    q: Tensor
    mass_eigenvalue: Tensor
    mass_condition: Tensor
    damping_eigenvalue: Tensor
    input_singular_value: Tensor
    input_condition: Tensor
    fully_actuated: bool

    def to_frame(self) -> pd.DataFrame:
        """One row per configuration: q1 to qN, then every number of that configuration."""
        columns = {k: v for k, v in vars(self).items() if isinstance(v, Tensor) and k != "q"}
        return per_configuration(self.q, columns)


def check_without_truth(model: MechanicalSystem, q: Tensor, *, region: str) -> ModelCheck:
    """What can be said of a learned model whose truth nobody knows; N and M may differ.

    Args:
        model: the learned system.
        q: configurations, ``(K, N)``.
        region: a name for where the configurations come from.

    Raises:
        TypeError: if the model is no mechanical system.
        ValueError: if ``q`` is not ``(K, N)`` or not finite.
    """
    require_system("model", model)
    q = require_samples("q", q, model)
    with torch.no_grad():
        terms = double_copy(model, q.device).terms(q)
    mass = torch.linalg.eigvalsh(terms.M)
    singular = torch.linalg.svdvals(terms.A)
    return ModelCheck(
        region=region,
        q=q,
        mass_eigenvalue=mass[..., 0],
        mass_condition=mass[..., -1] / mass[..., 0],
        damping_eigenvalue=torch.linalg.eigvalsh(terms.D)[..., 0],
        input_singular_value=singular[..., -1],
        input_condition=singular[..., 0] / singular[..., -1],
        fully_actuated=model.num_coordinates == model.num_inputs,
    )


def stability_report(
    certificate: StabilityCertificate,
    steady_states: Sequence[SteadyState] = (),
    measured: Sequence[Tensor | None] | None = None,
    required_gains: Mapping[float, Tensor] | None = None,
) -> str:
    """Proposition 1 for one model in Markdown, for somebody who knows control.

    Args:
        certificate: the conditions over the region.
        steady_states: predictions, one for each choice of gains.
        measured: for each of them |q - q_ref| at the end of the measured runs, ``(K,)``, NaN for a
            run that was stopped; None where nothing was measured.
        required_gains: wanted steady-state error and the K_P that each set point needs for it.

    Raises:
        ValueError: if ``measured`` does not match the predictions.
    """
    measured = [None] * len(steady_states) if measured is None else measured
    sizes = [len(state.bound) for state in steady_states]
    found = [size if m is None else len(m) for m, size in zip(measured, sizes, strict=False)]
    if len(measured) != len(sizes) or found != sizes:
        raise ValueError(
            f"measured has {len(measured)} entries of lengths {found}, expected {len(sizes)} of "
            f"lengths {sizes}, one error for each set point of each prediction"
        )
    sections = [
        f"# Stability of the regulator over {certificate.region}",
        f"Proposition 1 of the paper at {len(certificate.q)} configurations, with "
        f"K_P = {_gain(certificate.position_gain)} and K_D = {_gain(certificate.velocity_gain)}. "
        "Every number is explained in docs/stability.md. What is checked is checked at these "
        "configurations, not between them.",
        _condition_1(certificate),
        _gain_products(certificate),
        _condition_2(certificate),
        _gravity_error(certificate),
    ]
    if steady_states:
        sections.append(_steady_states(steady_states, measured))
    if required_gains:
        rows = [
            [_number(error), _number(k.median()), _number(k.max())]
            for error, k in required_gains.items()
        ]
        table = _table(["wanted error", "K_P, median set point", "K_P, all set points"], rows)
        sections.append(
            "## Gain for a wanted steady-state error\n\nThe smallest scalar K_P for which the "
            f"bound is no larger: the κ of Proposition 1.\n\n{table}"
        )
    sections.append(_LIMITS)
    return "\n\n".join(sections) + "\n"


def model_report(check: ModelCheck) -> str:
    """The shorter report in Markdown, for a model whose truth nobody knows."""
    rows = []
    for name, values, least in (
        ("smallest eigenvalue of M_L", check.mass_eigenvalue, True),
        ("condition number of M_L", check.mass_condition, False),
        ("smallest eigenvalue of D_L", check.damping_eigenvalue, True),
        ("smallest singular value of A_L", check.input_singular_value, True),
        ("condition number of A_L", check.input_condition, False),
    ):
        worst = int(values.argmin() if least else values.argmax())
        typical = _number(values.median())
        rows.append([name, typical, _number(values[worst]), _vector(check.q[worst])])
    actuation = (
        "N = M, as Proposition 1 needs."
        if check.fully_actuated
        else "N and M differ: Proposition 1 says nothing about this system."
    )
    return (
        "\n\n".join(
            [
                f"# Learned model alone over {check.region}",
                f"{len(check.q)} configurations. {actuation}",
                _table(["", "median", "worst", "at q"], rows),
                f"M_L is positive definite at {_share(check.mass_eigenvalue > 0)} and D_L positive "
                f"semi-definite at {_share(check.damping_eigenvalue >= 0)} configurations. The law "
                "inverts A_L: where its condition number is large, a small error in G_L becomes a "
                "large error in u.",
                "Without the true A and G nothing can be said about conditions 1 and 2, Delta_all, "
                "the factor P or the steady-state error: a model can be perfect by every number "
                "above and wrong. Test trajectories and careful first runs have to show the rest.",
            ]
        )
        + "\n"
    )


def _condition_1(c: StabilityCertificate) -> str:
    verdict = _verdict(c.condition_1 > 0)
    return (
        "## Condition 1: the feedback pushes towards the set point\n\n"
        "The symmetric part of A A_L^T must be positive definite; eq. (PD_transpose), whatever "
        f"P. {verdict} Smallest eigenvalue: median {_number(c.condition_1.median())}, worst "
        f"{_number(c.condition_1.min())}.\n\n"
        + _worst(c.q, "smallest eigenvalue", c.condition_1, -c.condition_1)
    )


def _gain_products(c: StabilityCertificate) -> str:
    rows = [
        [name, _number(values.median()), _number(values.min()), _share(values > 0)]
        for name, values in (
            ("A A_L^T K_P", c.position_eigenvalue),
            ("A A_L^T K_D", c.velocity_eigenvalue),
        )
    ]
    return (
        "## Gains in the closed loop\n\n"
        "The proof takes these products for positive definite because their factors are. That "
        "follows for gains that are a number times the identity; for others it is checked here, "
        "by the smallest eigenvalue of the symmetric part.\n\n"
        + _table(["product", "median", "worst", "positive at"], rows)
    )


def _condition_2(c: StabilityCertificate) -> str:
    values = c.fitted.condition_2
    return (
        "## Condition 2: A_L is close to P A\n\n"
        "‖A^-1 P^-1 (A_L - P A)‖ must be below 1; eq. (smallenss_A_2). With the P that fits M, D, "
        f"G and A together: {_verdict(values < 1)} Median {_number(values.median())}, worst "
        f"{_number(values.max())}. With P = A_L A^-1 it is 0 everywhere, so wherever A and A_L "
        "are invertible some P meets this condition.\n\n"
        + _worst(c.q, "condition 2", values, values)
    )


def _gravity_error(c: StabilityCertificate) -> str:
    names = {
        "delta_A": "delta_A = ‖A_L - P A‖",
        "delta_G": "delta_G = ‖G_L - P G‖",
        "delta_I": "delta_I = ‖A_L^-1 - (P A)^-1‖",
        "delta_I_bound": "delta_I by the Neumann bound",
        "delta_all_bound": "‖Delta_all‖ by the triangle inequality",
    }
    rows = [
        [text, _number(getattr(c.fitted, name).max()), _number(getattr(c.matched, name).max())]
        for name, text in names.items()
    ]
    # The region's worst delta over the region's worst eigenvalue, as in the paper's argument.
    weakest = float(c.condition_1.min() * c.position_gain.min())
    crude = float(c.delta_all.max()) / weakest if weakest > 0 else float("inf")
    return (
        "## Error of the compensated potential force\n\n"
        "Delta_all = A A_L^-1 G_L - G is the force left over; it does not depend on P. "
        f"‖Delta_all‖: mean {_number(c.delta_all.mean())}, worst {_number(c.delta_all.max())}, "
        f"against ‖G‖ of {_number(c.potential_force.mean())} on average.\n\n"
        "Largest over the region, for two choices of P:\n\n"
        + _table(["", "P fitted to all terms", "P = A_L A^-1"], rows)
        + "\n\nAn arm that rests at one of these configurations is "
        f"{_number(c.rest_error.mean())} from its set point on average and "
        f"{_number(c.rest_error.max())} at worst, ‖(A A_L^T K_P)^-1 Delta_all‖. From the worst "
        "force over the weakest stiffness of the region it would be "
        f"{_number(crude)}.\n\n"
        + _worst(c.q, "distance from the set point", c.rest_error, c.rest_error)
    )


def _steady_states(states: Sequence[SteadyState], measured: Sequence[Tensor | None]) -> str:
    header = ["K_P", "K_D", "set points", "conditions hold", "bound", "predicted", "measured"]
    header += ["above the bound", "stopped", "slowest pole, 1/s", "control step below, s"]
    rows = []
    for state, error in zip(states, measured, strict=True):
        holds = state.holds
        row = [_gain(state.position_gain), _gain(state.velocity_gain), str(len(holds))]
        row += [_share(holds), _spread(state.bound[holds]), _spread(state.error[holds])]
        if error is None:
            row += ["-", "-", "-"]
        else:
            error = error.to(state.bound)
            over = (error > state.bound + MEASUREMENT_TOLERANCE) & holds
            ended = torch.isfinite(error)
            row += [
                _spread(error[holds & ended]),
                f"{int(over.sum())} of {int((holds & ended).sum())}",
            ]
            row += [str(int((~ended).sum()))]
        row += [_number(state.poles.real.max()), _number(2 / state.poles.abs().max())]
        rows.append(row)
    return (
        "## Steady-state error\n\n"
        "Median and largest ‖q - q_ref‖ over the set points where the conditions hold: the bound "
        "‖h(q_ref)‖ / (1 - L), the rest predicted from the equation of the equilibrium, and what "
        "was measured. The conditions: L < 1 in a ball of that radius, condition 1 in it, and "
        "all poles of the linearized loop to the left. L is the slope at the set point plus "
        f"{MARGIN:g} times its change over {SPHERE_POINTS} points of the sphere.\n\n"
        + _table(header, rows)
        + "\n\n"
        + "".join(_failures(state) for state in states)
        + "The poles are of the law in continuous time. A sampled controller needs a step below "
        "the one in the last column, 2 / |fastest pole|, and that alone does not suffice. A run "
        "has to last several times 1 / |slowest pole| before its end is a steady state."
    )


def _failures(state: SteadyState) -> str:
    if bool(state.holds.all()):
        return ""
    return (
        f"With K_P = {_gain(state.position_gain)}, K_D = {_gain(state.velocity_gain)} the "
        f"conditions fail: no ball with L < 1 at {int(state.bound.isinf().sum())} set points, "
        f"condition 1 at {int((state.condition_1 <= 0).sum())}, no stable equilibrium found at "
        f"{int((~state.stable).sum())}.\n\n"
    )


_LIMITS = (
    "## What this does not show\n\n"
    "- Nothing is proven between the samples of the region; L carries a margin, not a proof.\n"
    "- The bound is on where the arm rests, once it rests near the set point. That it gets there "
    "from far away is not shown.\n"
    "- The law is in continuous time, without delay, noise or limits of the input, and the plant "
    "without dry friction."
)


def _verdict(good: Tensor) -> str:
    if bool(good.all()):
        return f"It holds at all {good.numel()} configurations."
    return f"**It fails at {int((~good).sum())} of {good.numel()} configurations.**"


def _worst(q: Tensor, name: str, values: Tensor, badness: Tensor) -> str:
    order = badness.argsort(descending=True)[:3].tolist()
    rows = [[str(k), _vector(q[k]), _number(values[k])] for k in order]
    return "Worst configurations:\n\n" + _table(["index", "q", name], rows)


def _share(good: Tensor) -> str:
    return f"{int(good.sum())} of {good.numel()}"


def _spread(values: Tensor) -> str:
    if values.numel() == 0:
        return "-"
    return f"{_number(values.median())} / {_number(values.max())}"


def _gain(diagonal: Tensor) -> str:
    same = bool((diagonal == diagonal[0]).all())
    return _number(diagonal[0]) if same else f"diag{_vector(diagonal)}"


def _vector(values: Tensor) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values.tolist()) + ")"


def _number(value: Tensor | float) -> str:
    return f"{float(value):.3g}"


def _table(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
