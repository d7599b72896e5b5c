"""Named quantities have the simulator's values, and task quantities the rewards of the suite."""

import numpy as np
import pytest

from latentplan.config import EnvConfig
from latentplan.config.quantities import QUANTITIES, TASK_PREFIX, scales
from latentplan.envs import make_env
from latentplan.envs.true_quantities import clause_degree, measure, true_values

NOT_IN_THE_SUITE = {("walker", "backward"), ("cheetah", "backward")}
REWARDS = [
    (domain, quantity.name.removeprefix(TASK_PREFIX))
    for domain, quantities in QUANTITIES.items()
    for quantity in quantities
    if quantity.name.startswith(TASK_PREFIX)
]


def load(domain, task):
    from dm_control import suite

    return suite.load(domain, task, task_kwargs={"random": 0})


def value(domain, physics, name):
    return true_values(domain, physics)[list(scales(domain)).index(name)]


@pytest.mark.parametrize(("domain", "task"), [pair for pair in REWARDS if pair not in NOT_IN_THE_SUITE])
def test_task_quantities_equal_the_rewards_of_the_suite(domain, task):
    env, rng = load(domain, task), np.random.default_rng(0)
    spec = env.action_spec()
    errors = []
    for _ in range(3):
        env.reset()
        for _ in range(25):
            # Large velocities reach the parts of the rewards that random actions do not reach.
            env.physics.data.qvel[:] += rng.normal(size=env.physics.data.qvel.shape)
            timestep = env.step(rng.uniform(spec.minimum, spec.maximum))
            errors.append(abs(value(domain, env.physics, f"task.{task}") - timestep.reward))
    assert max(errors) < 1e-9


@pytest.mark.parametrize(
    ("domain", "task"), [("reacher", "easy"), ("reacher", "hard"), ("ball_in_cup", "catch"), ("finger", "turn_hard")]
)
def test_task_quantities_of_sparse_tasks_are_1_at_the_target(domain, task):
    env = load(domain, task)
    env.reset()
    data, model = env.physics.named.data, env.physics.named.model
    with env.physics.reset_context():
        if domain == "ball_in_cup":
            data.qpos[["ball_x", "ball_z"]] += env.physics.ball_to_target()
        elif domain == "finger":
            model.site_pos["target", ["x", "z"]] = data.site_xpos["tip", ["x", "z"]]
        else:
            model.geom_pos["target", ["x", "y"]] = data.geom_xpos["finger", ["x", "y"]]
    assert value(domain, env.physics, f"task.{task}") == env.task.get_reward(env.physics) == 1.0


@pytest.mark.parametrize(("domain", "forward"), [("walker", "walk"), ("cheetah", "run")])
def test_task_quantity_backward_mirrors_the_forward_reward(domain, forward):
    env = load(domain, "run")
    env.reset()
    paid = {}
    for velocity in (-1.2, 1.2):
        with env.physics.reset_context():
            env.physics.named.data.qvel["rootx"] = velocity
        paid[velocity] = [value(domain, env.physics, name) for name in (f"task.{forward}", "task.backward")]
    assert paid[1.2] == pytest.approx(paid[-1.2][::-1], abs=1e-9)
    assert paid[1.2][0] > paid[1.2][1]


@pytest.mark.parametrize("domain", QUANTITIES)
def test_measure_gives_one_value_per_name(domain):
    env = load(domain, REWARDS[[pair[0] for pair in REWARDS].index(domain)][1])
    env.reset()
    names, values = tuple(scales(domain)), measure(domain, env.physics)
    assert (values.shape, values.dtype) == ((len(names),), np.float32)
    assert len(set(names)) == len(names)
    assert all(name.removeprefix(TASK_PREFIX).isidentifier() for name in names)
    assert min(scales(domain).values()) > 0


def test_true_values_are_those_of_the_body():
    env = load("cartpole", "swingup")
    env.reset()
    for angle in (0.0, 0.5, -2.0, 3.5):
        with env.physics.reset_context():
            env.physics.named.data.qpos["slider"], env.physics.named.data.qpos["hinge_1"] = 0.7, angle
            env.physics.data.qvel[:] = (0.3, -4.0)
        names, values = scales("cartpole"), true_values("cartpole", env.physics)
        found = dict(zip(names, values, strict=True))
        wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
        expected = {"cart": 0.7, "pole_angle": wrapped, "upright": np.cos(angle), "cart_speed": 0.3, "pole_speed": -4.0}
        assert {name: found[name] for name in expected} == pytest.approx(expected, abs=1e-9)


def test_measure_is_empty_for_a_domain_without_quantities():
    env = load("acrobot", "swingup")
    assert scales("acrobot") == {}
    assert measure("acrobot", env.physics).shape == (0,)


def test_clause_degree_is_a_tenth_at_a_shortfall_of_one_margin():
    degrees = clause_degree(np.array([-3.0, 0.0, 0.5, 1.0, np.nan]))
    assert degrees[:4] == pytest.approx([1.0, 1.0, 0.1**0.25, 0.1])
    assert np.isnan(degrees[4])


def test_step_reports_true_values_after_each_control_step_when_recorded():
    config = EnvConfig("walker", "walk", action_repeat=3, render_quality="fastest")
    env, twin = make_env(config, seed=1), load("walker", "walk")
    env.record_quantities = True
    _, start = env.reset(seed=1)
    twin.reset()
    with twin.physics.reset_context():
        twin.physics.set_state(env.true_state())
    action = np.full(env.action_space.shape, 0.3)
    for _ in range(2):
        *_, reward, _, _, info = env.step(action)
        steps = [(twin.step(action).reward, true_values("walker", twin.physics)) for _ in range(3)]
        assert info["rewards"] == pytest.approx([pay for pay, _ in steps], abs=1e-9)
        assert info["quantities"] == pytest.approx(np.stack([values for _, values in steps]), abs=1e-9)
        assert reward == pytest.approx(info["rewards"].sum())
    assert "quantities" not in start
    env.record_quantities = False
    assert "quantities" not in env.step(action)[-1]
    env.close()
