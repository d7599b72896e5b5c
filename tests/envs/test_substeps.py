"""Actions that change within a decision: the simulation equals a simulation with separate control steps."""

import numpy as np
import pytest

from latentplan.config import EnvConfig
from latentplan.envs import make_env
from latentplan.envs.substeps import split_schedule

DOMAINS = ("walker", "cartpole", "hopper")  # ten, one and four substeps per control step; cartpole integrates by RK4


def config(domain="walker", action_repeat=2):
    return EnvConfig(domain=domain, render_quality="fastest", action_repeat=action_repeat)


@pytest.fixture(scope="module", params=DOMAINS)
def env(request):
    env = make_env(config(request.param), seed=0)
    yield env
    env.close()


@pytest.fixture(scope="module")
def walker():
    env = make_env(config(), seed=0)
    yield env
    env.close()


def some_actions(env, count=6):
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, *env.action_space.shape))


def played(env, decide):
    """Frames, rewards and states of a few decisions, each made by `decide(env, action)`."""
    env.reset(seed=3)
    steps = [(*decide(env, action)[:2], env.true_state()) for action in some_actions(env)]
    return [np.stack(parts) for parts in zip(*steps, strict=True)]


def same(one, other):
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_step_equals_the_simulators_own_control_steps(env):
    def by_hand(env, action):
        spec = env._task_env.action_spec()
        control = spec.minimum + (action + 1.0) * 0.5 * (spec.maximum - spec.minimum)
        reward = sum(float(env._task_env.step(control).reward) for _ in range(env.action_repeat))
        return env.render(), reward

    assert same(played(env, lambda env, action: env.step(action)), played(env, by_hand))


def test_step_schedule_equals_step_when_all_its_actions_are_equal(env):
    total = env.substeps_per_decision
    whole = played(env, lambda env, action: env.step(action))
    for cut in {1, total // 2, total - 1}:
        assert same(whole, played(env, lambda env, a, cut=cut: env.step_schedule([(a, cut), (a, total - cut)])))
    assert same(whole, played(env, lambda env, action: env.step_schedule([(action, 1)] * total)))


def test_step_schedule_equals_two_decisions_when_the_action_changes_between_control_steps(walker):
    single = make_env(config(action_repeat=1), seed=0)
    one, other = some_actions(walker, 2)
    walker.reset(seed=1)
    single.reset(seed=1)
    _, reward, *_ = walker.step_schedule([(one, 10), (other, 10)])
    assert reward == single.step(one)[1] + single.step(other)[1]
    assert np.array_equal(walker.true_state(), single.true_state())
    single.close()


def test_step_schedule_changes_the_action_at_its_substep(walker):
    one, other = some_actions(walker, 2)
    walker.reset(seed=1)
    walker.step_schedule([(one, 3), (other, 17)])
    changed = walker.true_state()
    walker.reset(seed=1)
    for action, count in ((one, 3), (other, 7), (other, 10)):  # walker's controls are the actions themselves
        walker.physics.set_control(action)
        walker.physics.step(count)
    assert np.array_equal(changed, walker.true_state())


def test_step_lasts_as_long_as_before_after_a_schedule(walker):
    one, other = some_actions(walker, 2)
    walker.reset(seed=1)
    walker.step_schedule([(one, 3), (other, 17)])
    before = walker.physics.time()
    _, _, _, _, info = walker.step(one)
    assert walker.physics.time() - before == pytest.approx(0.05)
    assert info["env_frames"] == 2


def test_step_schedule_ends_early_at_the_time_limit():
    env = make_env(config("cartpole", action_repeat=300), seed=0)
    env.reset(seed=0)
    action = np.zeros(1)
    ended = [env.step_schedule([(action, 250), (action, 50)])[2:] for _ in range(4)]
    env.close()
    assert [truncated for _, truncated, _ in ended] == [False, False, False, True]
    assert ended[-1][-1]["env_frames"] == 100


@pytest.mark.parametrize("counts", [(), (19,), (21,), (0, 20), (-1, 21)])
def test_step_schedule_refuses_substeps_that_do_not_add_up(walker, counts):
    walker.reset(seed=0)
    with pytest.raises(ValueError, match="add up to 20"):
        walker.step_schedule([(np.zeros(6), count) for count in counts])


def test_split_schedule_keeps_order_and_substeps():
    steps = list(split_schedule([("a", 3), ("b", 4), ("c", 2)], 4))
    assert steps == [[("a", 3), ("b", 1)], [("b", 3), ("c", 1)]]
