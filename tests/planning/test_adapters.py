"""`CEMTrajectoryOptimizer` and its controller, with the demonstration of their interface."""

import numpy as np
import pytest

from latentplan.planning import CEMTrajectoryOptimizer, ModelPredictiveController

DEMONSTRATION = """
optimizer = CEMTrajectoryOptimizer(horizon=2, action_dim=1)

# Hand-crafted candidate sequences A = [a_0, a_1] matching worked example
test_candidates = np.array([
    [[0.5], [0.8]],   # A_1 -> return 3.2
    [[-0.5], [0.2]],  # A_2 -> return 1.0
    [[0.8], [0.6]],   # A_3 -> return 4.0
    [[-1.0], [-0.5]]  # A_4 -> return -0.5
], dtype=np.float64)
test_returns = np.array([3.2, 1.0, 4.0, -0.5], dtype=np.float64)

mu_0 = np.array([[0.0], [0.0]], dtype=np.float64)
var_0 = np.array([[1.0], [1.0]], dtype=np.float64)

new_mu, new_var, a0_star = optimizer.step_numerical_example(
    candidates=test_candidates,
    returns=test_returns,
    prior_mean=mu_0,
    prior_var=var_0,
    num_elites=2,
    smoothing=0.8,
)

print(f"Refitted Mean mu^(1): [{new_mu[0, 0]:.2f}, {new_mu[1, 0]:.2f}]")
# -> Refitted Mean mu^(1): [0.52, 0.56]

print(f"Refitted Var sigma^(1): [{new_var[0, 0]:.4f}, {new_var[1, 0]:.4f}]")
# -> Refitted Var sigma^(1): [0.2180, 0.2080]

print(f"First Executed Action a_0^*: {a0_star[0]:.2f}")
# -> First Executed Action a_0^*: 0.52

# Assert exact numerical results
np.testing.assert_allclose(new_mu.flatten(), [0.52, 0.56], atol=1e-5)
np.testing.assert_allclose(new_var.flatten(), [0.2180, 0.2080], atol=1e-5)
np.testing.assert_allclose(a0_star[0], 0.52, atol=1e-5)
print("CEM step assertions verified successfully.")
# -> CEM step assertions verified successfully.
"""


def rollout(state, sequence):
    """Return of driving a point (position, velocity) to the origin; NumPy in, a float out."""
    assert isinstance(sequence, np.ndarray) and sequence.dtype == np.float64
    position, velocity, total = state[0], state[1], 0.0
    for action in sequence:
        velocity = velocity + 0.3 * action[0]
        position = position + 0.3 * velocity
        total -= position**2 + 0.1 * velocity**2
    return total


def test_optimizer_demonstration_prints_its_numbers(capsys):
    names = {"np": np, "CEMTrajectoryOptimizer": CEMTrajectoryOptimizer}
    exec(DEMONSTRATION, names)
    assert capsys.readouterr().out.splitlines() == [
        "Refitted Mean mu^(1): [0.52, 0.56]",
        "Refitted Var sigma^(1): [0.2180, 0.2080]",
        "First Executed Action a_0^*: 0.52",
        "CEM step assertions verified successfully.",
    ]


def test_rollout_controller_reaches_its_goal():
    optimizer = CEMTrajectoryOptimizer(horizon=8, action_dim=1)
    controller = ModelPredictiveController(optimizer=optimizer, rollout_fn=rollout)
    state = np.array([1.0, 0.0])
    for _ in range(25):
        action = controller.act(state)
        assert isinstance(action, np.ndarray) and action.shape == (1,)
        velocity = state[1] + 0.3 * action[0]
        state = np.array([state[0] + 0.3 * velocity, velocity])
    assert np.abs(state).max() < 0.1


def test_rollout_controller_pads_the_shifted_plan_with_zero():
    controller = ModelPredictiveController(CEMTrajectoryOptimizer(4, 1), rollout)
    action = controller.act(np.array([1.0, 0.0]))
    mean, var = CEMTrajectoryOptimizer(4, 1).plan(np.array([1.0, 0.0]), rollout)
    assert mean.shape == var.shape == (4, 1) and mean.dtype == np.float64
    np.testing.assert_array_equal(action, mean[0])
    np.testing.assert_array_equal(controller.warm_start, np.concatenate([mean[1:], [[0.0]]]))
    controller.reset()
    assert controller.warm_start is None


@pytest.mark.parametrize(("low", "high"), [(0.5, 1.0), ([0.5, -3.0], [1.0, -1.0])])
def test_search_starts_and_ends_in_the_middle_of_the_bounds(low, high):
    optimizer = CEMTrajectoryOptimizer(3, 2, action_low=low, action_high=high)
    middle, seen = (np.asarray(low) + np.asarray(high)) / 2, []
    controller = ModelPredictiveController(optimizer, lambda state, sequence: seen.append(sequence) or 0.0)
    controller.act(np.zeros(1))
    np.testing.assert_allclose(seen[0], np.broadcast_to(middle, (3, 2)))
    np.testing.assert_allclose(controller.warm_start[-1], np.broadcast_to(middle, 2))


def test_optimizer_searches_the_whole_action_range():
    optimizer = CEMTrajectoryOptimizer(3, 1, action_low=-100.0, action_high=100.0)
    mean, _ = optimizer.plan(np.zeros(1), lambda state, sequence: -float(((sequence - 50.0) ** 2).sum()))
    assert np.abs(mean - 50.0).max() < 10.0


def test_optimizer_starts_at_warm_start_mean_unshifted():
    optimizer = CEMTrajectoryOptimizer(3, 2, num_candidates=4, num_elites=4, num_iterations=1, smoothing=1e-12)
    given = np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
    mean, _ = optimizer.plan(np.zeros(1), lambda state, sequence: 0.0, given)
    np.testing.assert_allclose(mean, given, atol=1e-9)


def test_optimizer_passes_the_state_unchanged_and_sequences_within_bounds():
    seen, state = [], object()

    def record(given, sequence):
        assert given is state
        seen.append(sequence.copy())
        return float(sequence.sum())

    CEMTrajectoryOptimizer(3, 2, action_low=-0.5, action_high=0.25).plan(state, record)
    assert np.min(seen) >= -0.5 and np.max(seen) <= 0.25 and len(seen) == 5 * 100


def test_optimizers_with_equal_seeds_give_equal_plans():
    plans = [CEMTrajectoryOptimizer(3, 1, seed=seed).plan(np.array([1.0, 0.0]), rollout)[0] for seed in (4, 4, 5)]
    np.testing.assert_array_equal(plans[0], plans[1])
    assert not np.array_equal(plans[0], plans[2])


def test_optimizer_names_a_bad_setting():
    with pytest.raises(ValueError, match="num_elites"):
        CEMTrajectoryOptimizer(3, 1, num_candidates=5)


@pytest.mark.parametrize("start", [np.full((3, 1), np.nan), np.zeros(3), np.zeros((1, 3, 1))])
def test_optimizer_refuses_a_start_that_is_no_finite_sequence(start):
    with pytest.raises(ValueError, match="warm_start_mean must be finite numbers"):
        CEMTrajectoryOptimizer(3, 1).plan(np.zeros(2), rollout, start)


def test_rollout_fn_may_write_to_its_sequence():
    def written(state, sequence):
        sequence += state
        return -float(((sequence - 1.5) ** 2).sum())

    def copied(state, sequence):
        return written(state, sequence.copy())

    plans = [CEMTrajectoryOptimizer(3, 1).plan(np.ones(1), function)[0] for function in (written, copied)]
    np.testing.assert_array_equal(*plans)


def test_optimizer_warns_when_no_return_is_finite():
    with pytest.warns(RuntimeWarning, match="no sequence had a finite return"):
        mean, _ = CEMTrajectoryOptimizer(3, 1).plan(np.ones(1), lambda state, sequence: float("nan"))
    assert (mean == 0.0).all()


def test_step_numerical_example_accepts_integer_returns():
    candidates, zeros = np.arange(6, dtype=np.float32).reshape(3, 2, 1), np.zeros((2, 1))
    plans = [
        CEMTrajectoryOptimizer(2, 1).step_numerical_example(candidates, returns, zeros, zeros + 1.0)
        for returns in (np.array([3, 1, 4]), np.array([3.0, 1.0, 4.0]))
    ]
    for whole, real in zip(*plans, strict=True):
        np.testing.assert_array_equal(whole, real)
