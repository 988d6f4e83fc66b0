"""benchmarks/many_segments.py: its lists fit an arm of any number of segments."""

import pytest

from benchmarks.many_segments import control, training
from pinn_dyn.app.build import build_source
from tests.docs.commands import check_overrides, compose


@pytest.mark.parametrize("segments", [2, 16])
def test_the_lists_have_three_numbers_a_segment(tmp_path, segments):
    config = compose("train", training(segments), tmp_path)
    source = build_source(config)
    assert source.system.num_coordinates == len(source.labels) == 3 * segments
    assert source.configurations["straight"] == [0.0, 0.0, 0.05] * segments
    check_overrides("control", ["run=x", *control(segments)], tmp_path)
