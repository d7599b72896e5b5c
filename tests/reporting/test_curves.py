"""Learning curves are read from metrics files and drawn."""

import cv2
import pytest

from latentplan.reporting.curves import plot_curves, read_curve

METRICS = """env_frames,updates,minutes,model_loss,planner_return,actor_return
1000,100,0.5,3.2,,
2000,200,1.0,2.9,110.5,90.0
3000,300,1.5,2.5,,
4000,400,2.0,2.2,300.0,310.25
"""


@pytest.fixture
def metrics(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text(METRICS)
    return path


def test_read_curve_skips_rows_without_a_measurement(metrics):
    assert read_curve(metrics, "env_frames", "planner_return") == ([2000.0, 4000.0], [110.5, 300.0])
    assert read_curve(metrics, "minutes", "actor_return") == ([1.0, 2.0], [90.0, 310.25])


def test_read_curve_names_the_missing_column_and_the_present_ones(metrics):
    with pytest.raises(ValueError, match="'value_loss'.*planner_return"):
        read_curve(metrics, "env_frames", "value_loss")


def test_plot_curves_draws_both_curves_in_both_panels(metrics, tmp_path):
    image = cv2.cvtColor(cv2.imread(str(plot_curves(metrics, tmp_path / "curves.png"))), cv2.COLOR_BGR2HSV)
    for half in (image[:, : image.shape[1] // 2], image[:, image.shape[1] // 2 :]):
        strong = half[..., 0][half[..., 1] > 150]
        assert ((strong > 95) & (strong < 110)).sum() > 100  # blue: the planner
        assert ((strong > 10) & (strong < 22)).sum() > 100  # orange: the actor


def test_plot_curves_writes_an_empty_figure_when_there_is_no_evaluation(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("env_frames,minutes,planner_return,actor_return\n")
    plot_curves(path, tmp_path / "curves.png")
    assert cv2.imread(str(tmp_path / "curves.png")) is not None
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["curves.png", "metrics.csv"]
