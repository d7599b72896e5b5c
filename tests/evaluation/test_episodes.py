import math

import gymnasium
import numpy as np
import pytest

from latentplan.config import UserError
from latentplan.evaluation.episodes import episode_seed, iterate_episodes, run_episodes
from latentplan.evaluation.statistics import confidence_interval, latency_percentiles, summarize


class ClockEnv(gymnasium.Env):
    """Every pixel tells the time, counted from a start drawn by the seed; the reward is the action."""

    def __init__(self, length=5, terminates=False):
        self.observation_space = gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.length, self.terminates = length, terminates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.start, self.time = int(self.np_random.integers(100)), 0
        return self._frame(), {"env_frames": 0}

    def step(self, action):
        self.time += 1
        over = self.time == self.length
        return (
            self._frame(),
            float(action[0]),
            over and self.terminates,
            over and not self.terminates,
            {"env_frames": 4},
        )

    def _frame(self):
        return np.full((64, 64, 3), self.start + self.time, np.uint8)


class NoisyAgent:
    """Adds noise of its own stream to a constant, and counts what it saw since the last reset."""

    def __init__(self, constant=0.0):
        self.constant, self.seen = constant, None

    def seed(self, seed):
        self.rng = np.random.default_rng(seed)

    def reset(self):
        self.seen = []

    def act(self, frame):
        self.seen.append(int(frame[0, 0, 0]))
        return np.float32([self.constant + 0.1 * self.rng.uniform(-1, 1)])


def first_frames(env, agent, seeds):
    starts = []
    run_episodes(env, agent, seeds, on_step=lambda step: step.decision == 0 and starts.append(step.frame[0, 0, 0]))
    return starts


def returns_of(episodes):
    return [episode.total_return for episode in episodes]


def test_episode_seeds_depend_on_seed_and_index_only():
    seeds = [episode_seed(seed, index) for seed in range(5) for index in range(20)]
    assert len(set(seeds)) == 100
    assert seeds == [episode_seed(seed, index) for seed in range(5) for index in range(20)]


def test_episode_seeds_suit_every_generator():
    assert all(0 <= episode_seed(0, index) < 2**32 for index in range(1000))


def test_agents_meet_the_same_starts():
    seeds = [episode_seed(0, index) for index in range(4)]
    starts = first_frames(ClockEnv(), NoisyAgent(), seeds)
    assert starts == first_frames(ClockEnv(length=9), NoisyAgent(0.5), seeds)
    assert len(set(starts)) > 1


def test_an_episode_does_not_depend_on_those_before_it():
    seeds = [episode_seed(3, index) for index in range(4)]
    env, agent = ClockEnv(), NoisyAgent()
    together = returns_of(run_episodes(env, agent, seeds))
    alone = [returns_of(run_episodes(env, agent, [seed]))[0] for seed in reversed(seeds)]
    assert together == alone[::-1]


def test_the_stream_of_the_agent_is_not_the_stream_of_the_start():
    class Recorder(NoisyAgent):
        def seed(self, seed):
            self.given = seed
            super().seed(seed)

    agent = Recorder()
    run_episodes(ClockEnv(), agent, [7])
    assert agent.given != 7


def test_the_agent_sees_every_frame_but_the_last_in_order():
    agent = NoisyAgent()
    run_episodes(ClockEnv(length=6), agent, [1])
    assert agent.seen == list(range(agent.seen[0], agent.seen[0] + 6))


@pytest.mark.parametrize("terminates", [False, True])
def test_episodes_end_where_the_environment_ends(terminates):
    (episode,) = run_episodes(ClockEnv(length=7, terminates=terminates), NoisyAgent(), [0])
    assert (episode.num_decisions, episode.env_frames, episode.decision_ms.shape) == (7, 28, (7,))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_reward_that_is_no_number_is_an_error(value):
    with pytest.raises(UserError, match="not finite"):
        run_episodes(ClockEnv(), NoisyAgent(value), [0])


def test_steps_tell_the_reward_before_the_action_and_then_the_end():
    steps = []
    (episode,) = run_episodes(ClockEnv(length=3), NoisyAgent(1.0), [0], on_step=steps.append)
    assert [step.decision for step in steps] == [0, 1, 2, 3]
    assert [step.action is None for step in steps] == [False, False, False, True]
    assert steps[0].total_return == 0.0
    assert np.diff([step.total_return for step in steps]) == pytest.approx([step.action[0] for step in steps[:-1]])
    assert steps[-1].total_return == episode.total_return


def test_decision_time_leaves_out_the_simulator_and_the_callback():
    import time

    class SlowEnv(ClockEnv):
        def step(self, action):
            time.sleep(0.05)
            return super().step(action)

    (episode,) = run_episodes(SlowEnv(), NoisyAgent(), [0], on_step=lambda step: time.sleep(0.05))
    assert np.median(episode.decision_ms) < 25.0  # either sleep inside would make it 50


def test_finished_episodes_are_there_before_the_next_begins():
    class Impatient(NoisyAgent):
        def act(self, frame):
            if len(finished) == 2:
                raise KeyboardInterrupt
            return super().act(frame)

    finished = []
    with pytest.raises(KeyboardInterrupt):
        for episode in iterate_episodes(ClockEnv(), Impatient(), [0, 1, 2]):
            finished.append(episode)
    assert len(finished) == 2


@pytest.mark.parametrize(
    ("freedom", "quantile"),
    [(1, 12.7062), (4, 2.7764), (9, 2.2622), (10, 2.2281), (11, 2.2010), (19, 2.0930), (99, 1.9842)],
)
def test_intervals_are_students(freedom, quantile):
    returns = np.random.default_rng(0).normal(size=freedom + 1)
    low, high = confidence_interval(returns)
    half = quantile * returns.std(ddof=1) / math.sqrt(freedom + 1)
    assert (low, high) == pytest.approx((returns.mean() - half, returns.mean() + half), abs=2e-4)


def test_intervals_cover_the_truth_95_times_in_100():
    rng = np.random.default_rng(0)
    intervals = np.array([confidence_interval(rng.normal(size=5)) for _ in range(4000)])
    covered = np.mean((intervals[:, 0] < 0) & (intervals[:, 1] > 0))
    assert covered == pytest.approx(0.95, abs=0.012)  # 3.5 standard errors of 4000 trials


def test_one_return_has_no_interval():
    assert all(math.isnan(bound) for bound in confidence_interval([3.0]))


def test_equal_returns_have_an_interval_of_no_width():
    assert confidence_interval([2.0, 2.0, 2.0]) == (2.0, 2.0)


def test_no_return_is_an_error():
    with pytest.raises(ValueError, match="at least one"):
        confidence_interval([])


def test_percentiles_are_in_order_and_exact_on_a_ramp():
    assert latency_percentiles(np.arange(101.0)) == {"p50": 50.0, "p95": 95.0, "p99": 99.0}


def test_a_summary_of_one_episode_has_no_nan():
    summary = summarize(run_episodes(ClockEnv(), NoisyAgent(), [0]))
    assert summary["ci95"] == [None, None]
    assert summary["episodes"] == 1
    assert summary["mean_return"] == summary["returns"][0]
