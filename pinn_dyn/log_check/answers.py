"""Answers of the equation of motion of a log to the questions about its inputs and its runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pinn_dyn.data import logs
from pinn_dyn.data.logs.check.plausibility import LOST
from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.log_check import numbers
from pinn_dyn.log_check.averages import (
    Averages,
    averages_of_widths,
    compared,
    parts_of,
    with_products,
)
from pinn_dyn.log_check.chain import chain_regressor, check_order
from pinn_dyn.log_check.delay import DelayCurve, clear_delays, input_delays
from pinn_dyn.log_check.equation import Regressor
from pinn_dyn.log_check.input_faults import DRIFT, HELD, SATURATED, input_faults
from pinn_dyn.log_check.numbers import check_angles, check_velocity_lag
from pinn_dyn.log_check.runs import (
    Equation,
    Interval,
    check_rests,
    check_runs,
    equation_of_motion,
)
from pinn_dyn.log_check.structure import (
    StructureFit,
    compare_structure,
    fit_structure,
    regressor,
)
from pinn_dyn.models.structure import Structure

SECTION = "docs/bags_and_other_logs.md#is-the-log-good-enough"
"""Section of the documentation about the check of a log."""
OF_MOTORS = {"rad", "m", "Pa"}
"""Units of motor angles, lengths of tendons, and pressures."""
_EXPLAINED = 0.1  # share of the motion that inputs explain, below which a log is not suitable
_TARGET = 0.3  # part of the variance of q that the targets of servos leave
_FITS = 0.1  # usual residual of a window, below which no other equation is tried
_WRONG = "the robot of the URDF has other forces"  # reason why there is no delay


@dataclass(frozen=True)
class Log:
    """A log, and what is known before its equation of motion.

    Attributes:
        source: the log.
        structure: kinematics of its robot, or None.
        longest_delay: longest delay of an input that is tried, s.
    """

    source: logs.LogSource
    structure: Structure | None
    longest_delay: float = 0.3

    @cached_property
    def training(self) -> list[logs.Recording]:
        """Stretches of the training."""
        return self._stretches("train")

    def _stretches(self, *splits: str) -> list[logs.Recording]:
        inputs, parts = len(self.source.u.columns), self.source.cleaned
        stretches = [item for x in parts if x.split in splits for item in x.clean]
        return [replace(item, u=item.u[:, :inputs]) for item in stretches]  # no rates of inputs

    @cached_property
    def step(self) -> float:
        """Sample time, s."""
        return float(np.median(np.diff(self.training[0].t)))

    @property
    def square(self) -> bool:
        """True for an input per coordinate."""
        return len(self.source.u.columns) == len(self.source.q.columns)

    @property
    def motors(self) -> bool:
        """True if the inputs are positions or pressures of motors of a soft robot."""
        return self.structure is None and {*self.source.u.units} <= OF_MOTORS

    @cached_property
    def rigid(self) -> Regressor | None:
        """Regressor of a robot with an input per joint, or None."""
        inputs = len(self.source.u.columns)
        if self.structure is None or self.structure.num_coordinates != inputs:
            return None
        return regressor(self.structure)

    @cached_property
    def servo(self) -> bool:
        """True if the inputs are targets that the coordinates follow."""
        units = self.source.q.units
        if self.source.u.units[: len(units)] != units:
            return False
        return numbers.target_distance(self.training, self.step, self.longest_delay) < _TARGET

    @cached_property
    def parts(self) -> list[logs.Recording]:
        """Stretches of the training, or parts of long ones."""
        return parts_of(self.training, self.step)

    @cached_property
    def widths(self) -> list[Averages]:
        """Averages of all stretches with kernels of a few widths."""
        everything = [*self.parts, *parts_of(self._stretches("validation", "test"), self.step)]
        if len(self.source.u.columns) > len(self.source.q.columns):
            everything = [with_products(item) for item in everything]
        return averages_of_widths(everything, self.step)

    def of_training(self, widths: Sequence[Averages]) -> list[Averages]:
        """Return the averages of the training."""
        return [x.rows(x.stretch < len(self.parts)) for x in widths]

    def clear_delays(self, curves: Sequence[DelayCurve]) -> list[float]:
        """Return the clear delay of each input, s; 0 for others, as for the lag of a servo."""
        return [0.0] * len(curves) if self.servo else clear_delays(curves, self.step)


@dataclass
class Answers:
    """Answers of the equation of motion to the questions about a log.

    Attributes:
        curves: delay curve of each input.
        clear: delay of each input that is clear, s; 0 for others.
        held: rows for which the values of an input repeat, where its motion follows lines; else 1.
        measurements: measurements.
        late: averages with kernels of two widths, and inputs as they act.
        motion: equation of motion; None if the rows are too few.
        fit: comparison with the bodies of a URDF.
        driven: joint that each input drives, if there are fewer inputs than coordinates.
        odd: parts of runs that do not fit the others.
        of_parts: measurements of these parts.
    """

    curves: list[DelayCurve]
    clear: list[float]
    held: list[int]
    measurements: list[Measurement]
    late: Sequence[Averages] = ()
    motion: Equation | None = None
    fit: StructureFit | None = None
    driven: Sequence[int] = ()
    odd: Sequence[Interval] = ()
    of_parts: Sequence[Measurement] = ()


def ask(log: Log) -> Answers:
    """Ask the equation of motion, without the parts of runs that do not fit the others."""
    answers = _asked(log, log.widths)
    if answers.odd:
        odd = [np.any([x.of(data) for x in answers.odd], axis=0) for data in log.widths]
        again = _asked(log, [x.rows(~rows) for x, rows in zip(log.widths, odd, strict=True)])
        if not _are_bad(again.measurements, SATURATED):  # which odd parts look like
            names = {x.name for x in answers.of_parts}
            kept = [x for x in again.measurements if x.name not in names]
            answers = replace(again, measurements=[*answers.of_parts, *kept])
    if answers.late:
        _describe(log, answers)
    return answers


def _are_bad(measurements: Sequence[Measurement], *names: str) -> bool:
    """Tell whether a measurement of these names is not ok."""
    return any(x.name in names and x.verdict != "ok" for x in measurements)


def _asked(log: Log, widths: Sequence[Averages]) -> Answers:
    """Ask for the order, the faults and the delays of the inputs, and compare the runs."""
    source, rigid = log.source, log.rigid
    curves = input_delays(
        log.parts,
        longest=log.longest_delay,
        rigid=rigid,
        widths=log.of_training(widths),
        motors=log.motors,
    )
    if not widths:
        return Answers(curves, [0.0] * len(curves), [1] * len(curves), [])
    chosen, order = [widths[k] for k in compared(widths)], None
    if not log.servo:
        delays = log.clear_delays(curves)
        order = check_order([x.delayed(delays) for x in chosen], source.u, source.q.units)
    faults, curves, held = input_faults(log.of_training(chosen), curves, source.u, rigid)
    if order is not None and log.square and order.joints != sorted(order.joints):
        curves = [x.without("the inputs are exchanged") for x in curves]
    clear = log.clear_delays(curves)
    late = [x.delayed(clear) for x in chosen]
    if order is not None and log.square:
        late = [order.corrected(x) for x in late]
    fit = None if log.structure is None else fit_structure(log.structure, log.of_training(late))
    fits = fit is None or not fit.bad
    narrow, wide = _equations(log, late, fits)
    answers = Answers(curves, clear, held, faults, late, narrow, fit)
    if order is not None and not log.square:
        answers.driven = order.joints
    # A fault of an input or of the clock explains runs that differ.
    if _are_bad([*faults, *source.measurements], DRIFT, HELD, LOST):
        return answers
    names = list(dict.fromkeys(item.run for item in late[0].recordings))
    answers.of_parts, answers.odd = check_rests(narrow, wide, names)
    if not answers.odd:
        of_runs, answers.odd = check_runs(narrow, wide, names, exact=fits)
        answers.of_parts = [*answers.of_parts, *of_runs]
    if not _are_bad(faults, SATURATED):
        of_order = [] if order is None else order.measurements
        answers.measurements = [*answers.of_parts, *of_order, *faults]
    return answers


def _describe(log: Log, answers: Answers) -> None:
    """Add what the averages say of coordinates, inputs and the URDF to the answers."""
    source, data = log.source, answers.late[0]
    of_robot: list[Measurement] = []
    if answers.fit is not None and log.structure is not None:
        of_robot, wrong = compare_structure(log.structure, answers.fit, source.u)
        if wrong:  # whose delays are wrong, too
            for k in (k for k in wrong if answers.curves[k].of_bodies):
                answers.curves[k] = answers.curves[k].without(_WRONG)
            answers.clear = log.clear_delays(answers.curves)
            answers.motion = equation_of_motion(data, source.q, source.u, data.width, log.rigid)
    answers.measurements += check_angles(data, source.q, _free(log))
    if source.v is not None:
        answers.measurements += check_velocity_lag(data, source.q, source.v)
    (training,) = log.of_training([data])
    answers.measurements += _inputs_measured(source, training, answers.curves, answers.clear)
    answers.measurements += of_robot


def _equations(log: Log, widths: Sequence[Averages], fits: bool) -> list[Equation | None]:
    """Return the equations with kernels of two widths.

    They are those of rigid bodies, or of a chain of unknown bodies. If these leave a part, those of
    single joints are used if they leave half of that: they have many more constants.
    """
    q, u, width = log.source.q, log.source.u, max(x.width for x in widths)

    def equations(bodies: Regressor | None) -> tuple[list[Equation | None], float]:
        results = [equation_of_motion(x, q, u, width, bodies) for x in widths]
        first = results[0]
        return results, np.inf if first is None else float(np.median(first.usual()))

    chain = chain_regressor(q.units) if log.square else None
    bodies = log.rigid if log.rigid is not None and fits else chain
    results, left = equations(bodies)
    if bodies is not None and left >= _FITS:
        of_joints, least = equations(None)
        results = of_joints if least < left / 2 else results
    return results


def _free(log: Log) -> list[bool]:
    """Return true for coordinates whose joints turn without end."""
    limits = getattr(log.structure, "limits", None)
    if limits is None:
        return [False] * len(log.source.q.columns)
    return [abs(high - low - 2 * np.pi) < 1e-6 for low, high in limits[:, :2].tolist()]


def _inputs_measured(
    source: logs.LogSource,
    data: Averages,
    delays: Sequence[DelayCurve],
    clear: Sequence[float],
) -> list[Measurement]:
    """Measure the share of the motion that the inputs explain, and their delays."""
    if not delays:
        return []
    data = replace(data, u=data.u[:, : len(delays)])
    lags = [(curve.delay or 0.0) - lag for curve, lag in zip(delays, clear, strict=True)]
    share = numbers.explained_share(data.delayed(lags))
    of_motion = judged(
        name="share of the motion that inputs add to (1, q, v)",
        place="inputs",
        value=share,
        expected=f"at least {_EXPLAINED}",
        bad=share < _EXPLAINED,
        text=f"the inputs explain {100 * share:.2g} % of the motion, at any delay: are these the "
        "inputs of this robot, on the same clock?",
        verdict="stop",
        section=SECTION,
    )
    of_delays = [
        judged(
            name="delay [ms]",
            place=name,
            value=np.nan if curve.delay is None else 1e3 * curve.delay,
            expected="no clear delay",
            bad=lag > 0,
            text=f"input {name!r} acts {1e3 * lag:.3g} ms after it is logged: add the delay below "
            "to the data set",
            section=SECTION,
        )
        for name, curve, lag in zip(source.u.columns, delays, clear, strict=True)
    ]
    return [of_motion, *of_delays]
