"""How good a model is: roll-out errors, learned terms against true ones, tables and figures."""

from pinn_dyn.evaluation.animation import animate, pose_strip
from pinn_dyn.evaluation.control_figures import (
    closed_loop_figure,
    controller_comparison_figure,
    steady_state_figure,
    tip_path_figure,
)
from pinn_dyn.evaluation.control_metrics import (
    ClosedLoopMetrics,
    closed_loop_metrics,
    comparison_table,
)
from pinn_dyn.evaluation.figures import (
    error_figure,
    save,
    spread_figure,
    terms_figure,
    trajectory_figure,
)
from pinn_dyn.evaluation.learned_terms import TermComparison, compare_terms
from pinn_dyn.evaluation.log_figures import cleaning_figure
from pinn_dyn.evaluation.metrics import (
    RolloutMetrics,
    diverged_trajectories,
    member_metrics,
    rollout_metrics,
)
from pinn_dyn.evaluation.prediction import Prediction, predict_trajectories, predict_windows
from pinn_dyn.evaluation.run_log import RunDescription
from pinn_dyn.evaluation.tables import (
    RunResult,
    format_table,
    grouped_table,
    summary_table,
    write_table,
)
from pinn_dyn.evaluation.validation import RolloutFigures, RolloutValidator

__all__ = [
    "ClosedLoopMetrics",
    "Prediction",
    "RolloutFigures",
    "RolloutMetrics",
    "RolloutValidator",
    "RunDescription",
    "RunResult",
    "TermComparison",
    "animate",
    "cleaning_figure",
    "closed_loop_figure",
    "closed_loop_metrics",
    "compare_terms",
    "comparison_table",
    "controller_comparison_figure",
    "diverged_trajectories",
    "error_figure",
    "format_table",
    "grouped_table",
    "member_metrics",
    "pose_strip",
    "predict_trajectories",
    "predict_windows",
    "rollout_metrics",
    "save",
    "spread_figure",
    "steady_state_figure",
    "summary_table",
    "terms_figure",
    "tip_path_figure",
    "trajectory_figure",
    "write_table",
]
