"""What TensorBoard is told about a run, read back from what it stores."""

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

FIGURES = {"rollout/trajectory", "rollout/error", "terms/bent", "terms/strongly_bent"}


def test_figures_are_logged_at_the_step_of_the_errors_that_they_explain(hnn_run):
    log = EventAccumulator(str(hnn_run / "tensorboard")).Reload()
    assert set(log.Tags()["images"]) == FIGURES
    (last,) = {log.Images(tag)[-1].step for tag in FIGURES}
    assert last == log.Scalars("val/error_mean")[-1].step == 3
