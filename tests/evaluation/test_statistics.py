"""Statistics of episodes: intervals, percentiles, summaries."""

import math

import numpy as np
import pytest

from latentplan.evaluation.statistics import (
    Episode,
    EpisodeRecord,
    confidence_interval,
    latency_percentiles,
    summarize,
)


def episode(total_return, decision_ms, **sources):
    return Episode(total_return, len(decision_ms), 4 * len(decision_ms), np.array(decision_ms), sources)


@pytest.mark.parametrize(
    ("freedom", "quantile"),
    [(1, 12.7062), (4, 2.7764), (9, 2.2622), (10, 2.2281), (11, 2.2010), (19, 2.0930), (99, 1.9842)],
)
def test_confidence_interval_has_the_width_of_students_t(freedom, quantile):
    returns = np.random.default_rng(0).normal(size=freedom + 1)
    low, high = confidence_interval(returns)
    half = quantile * returns.std(ddof=1) / math.sqrt(freedom + 1)
    assert (low, high) == pytest.approx((returns.mean() - half, returns.mean() + half), abs=2e-4)


def test_confidence_interval_covers_the_mean_95_times_in_100():
    rng = np.random.default_rng(0)
    intervals = np.array([confidence_interval(rng.normal(size=5)) for _ in range(4000)])
    covered = np.mean((intervals[:, 0] < 0) & (intervals[:, 1] > 0))
    assert covered == pytest.approx(0.95, abs=0.012)  # 3.5 standard errors of 4000 trials


def test_confidence_interval_is_nan_for_one_return():
    assert all(math.isnan(bound) for bound in confidence_interval([3.0]))


def test_confidence_interval_has_no_width_when_returns_are_equal():
    assert confidence_interval([2.0, 2.0, 2.0]) == (2.0, 2.0)


def test_confidence_interval_refuses_an_empty_list():
    with pytest.raises(ValueError, match="at least one"):
        confidence_interval([])


def test_latency_percentiles_are_exact_on_a_ramp():
    assert latency_percentiles(np.arange(101.0)) == {"p50": 50.0, "p95": 95.0, "p99": 99.0}


def test_summarize_pools_decisions_and_sources_of_all_episodes():
    summary = summarize([episode(1.0, [1.0, 2.0], plan=1, tail=1), episode(4.0, [3.0], actor=1)])
    assert (summary["episodes"], summary["returns"], summary["mean_return"]) == (2, [1.0, 4.0], 2.5)
    assert summary["decision_ms"]["p50"] == 2.0
    assert summary["action_source"] == {"plan": 1, "tail": 1, "actor": 1}
    assert summary["planned_fraction"] == pytest.approx(2 / 3)


def test_summarize_gives_none_for_the_interval_of_one_episode():
    summary = summarize([episode(1.5, [1.0], actor=1)])
    assert summary["ci95"] == [None, None]
    assert summary["mean_return"] == summary["returns"][0] == 1.5


def test_episode_record_counts_decisions_by_their_source():
    class Planner:
        last_source, was_surprised = "plan", False

    class Surprised:
        last_source, was_surprised = "actor", True

    record = EpisodeRecord()
    for agent in (Planner(), Surprised(), object()):  # an agent without the attributes counts as an actor
        record.add_decision(agent, 2.0)
        record.add_step(0.5, 4)
    found = record.episode()
    assert (found.total_return, found.num_decisions, found.env_frames, found.surprised) == (1.5, 3, 12, 1)
    assert found.action_source == {"plan": 1, "tail": 0, "actor": 2}
