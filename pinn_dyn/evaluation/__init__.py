"""Accuracy of models: rollout errors, learned terms beside true terms, tables and figures."""

from typing import TYPE_CHECKING

from pinn_dyn.evaluation.baselines import build_baselines
from pinn_dyn.evaluation.calibration import Calibration, calibration
from pinn_dyn.evaluation.control_metrics import ClosedLoopMetrics, closed_loop_metrics
from pinn_dyn.evaluation.learned_terms import TermComparison, compare_terms
from pinn_dyn.evaluation.metrics import RolloutMetrics, rollout_metrics
from pinn_dyn.evaluation.prediction import Prediction, predict_trajectories
from pinn_dyn.evaluation.torque import TorqueError, torque_error
from pinn_dyn.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from pinn_dyn.evaluation.animation import animate
    from pinn_dyn.evaluation.closed_loops import ControlResult, close_loop, close_loops
    from pinn_dyn.evaluation.control_figures import (
        closed_loop_figure,
        controller_comparison_figure,
        tip_path_figure,
    )
    from pinn_dyn.evaluation.evaluation import Entry, evaluate_models
    from pinn_dyn.evaluation.figures import (
        error_figure,
        sweep_figure,
        terms_figure,
        trajectory_figure,
    )
    from pinn_dyn.evaluation.log_figures import cleaning_figure
    from pinn_dyn.evaluation.results import Evaluation
    from pinn_dyn.evaluation.rollout_figures import RolloutFigures
    from pinn_dyn.evaluation.validation import RolloutValidator
    from pinn_dyn.plots import save

__all__ = [
    "Calibration",
    "ClosedLoopMetrics",
    "ControlResult",
    "Entry",
    "Evaluation",
    "Prediction",
    "RolloutFigures",
    "RolloutMetrics",
    "RolloutValidator",
    "TermComparison",
    "TorqueError",
    "animate",
    "build_baselines",
    "calibration",
    "cleaning_figure",
    "close_loop",
    "close_loops",
    "closed_loop_figure",
    "closed_loop_metrics",
    "compare_terms",
    "controller_comparison_figure",
    "error_figure",
    "evaluate_models",
    "predict_trajectories",
    "rollout_metrics",
    "save",
    "sweep_figure",
    "terms_figure",
    "tip_path_figure",
    "torque_error",
    "trajectory_figure",
]

__getattr__ = lazy_attributes(__name__)
