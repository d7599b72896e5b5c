"""A search pursues expressions over predicted quantities, and keeps constraints with some distance."""

from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from latentplan.config import EnvConfig, UserError
from latentplan.objectives.objective import plan_constraint, plan_degree, plan_goals, plan_objective, require_labels
from latentplan.objectives.parser import parse_constraints, parse_objective
from latentplan.planning import CEMPlanner
from latentplan.planning.objectives import Objective, Rollout, learned_return, predicted_return, terminal_value

SCALES = {"cart": 0.5, "cart_speed": 1.0, "task.right": 0.5}


class State(NamedTuple):
    features: Tensor

    @property
    def stoch(self):
        return self.features[:, :1]


class Cart:
    """A cart pushed by the action, whose quantities can be read off its state; it is paid for going left."""

    label_names = tuple(SCALES)

    def step(self, state, action):
        cart, speed = state.features.unbind(-1)
        speed = speed + 0.2 * action[:, 0]
        cart = cart + 0.1 * speed
        return State(torch.stack([cart, speed], dim=-1)), -cart

    def value(self, state):
        return -10 * state.features[:, 0]

    def probe(self, features):
        cart = features[..., :1]
        return torch.cat([features, torch.sigmoid(5 * cart)], dim=-1)


def objective(text, frames_per_step=1, encode_goal=None, guide=None):
    learned = predicted_return(Cart(), None)
    return plan_objective(parse_objective(text, SCALES), frames_per_step, learned, guide, encode_goal)


def plan_cart(text=None, constraints=(), start=(0.0, 0.0), **options):
    """Carts and speeds along the plan for a goal, (step,) each."""
    planner = CEMPlanner(
        action_dim=1, horizon=20, num_samples=200, num_elites=20, num_iterations=8, discount=0.99, **options
    )
    generator = torch.Generator().manual_seed(0)
    chosen = None if text is None else objective(text)
    state = State(torch.tensor([start]))
    plan = planner.plan(Cart(), state, objective=chosen, constraints=constraints, generator=generator)
    states = []
    for action in plan.actions[0]:
        state, _ = Cart().step(state, action[None])
        states.append(state.features[0])
    return torch.stack(states).unbind(-1)


def rollout_of(features, rewards=None, discount=0.5):
    """A rollout through states with features (step, row, 2)."""
    states = tuple(State(step) for step in features)
    steps, rows = features.shape[:2]
    weights = discount ** torch.arange(steps + 1.0)
    rewards = torch.zeros(rows, steps) if rewards is None else rewards
    return Rollout(Cart(), 1, 1, torch.zeros(rows, steps, 1), rewards, weights, states[0], states[-1], states)


def test_a_rollout_is_worth_its_discounted_degrees():
    carts = torch.tensor([[0.0, 1.0], [0.5, 1.0], [1.0, 1.0]])[..., None]
    rollout = rollout_of(torch.cat([carts, torch.zeros_like(carts)], dim=-1))
    half, none = plan_degree(torch.tensor([1.0, 2.0])).tolist()
    assert objective("cart > 1.0")(rollout).tolist() == pytest.approx([none + 0.5 * half + 0.25, 1.75])
    assert objective("0.5 * cart", frames_per_step=4)(rollout).tolist() == pytest.approx([1.0, 3.5])
    assert objective("2")(rollout).tolist() == pytest.approx([3.5, 3.5])


def test_the_planned_degree_rises_wherever_a_clause_does_not_hold():
    degrees = plan_degree(torch.linspace(20.0, -1.0, 300))
    assert bool((degrees.diff()[:280] > 0).all()) and degrees.min() > 0
    assert bool((degrees[-14:] == 1.0).all())
    assert bool(plan_degree(torch.tensor(float("nan"))).isnan())


def test_return_is_reward_and_value_and_can_be_weighted():
    features = torch.tensor([[[1.0, 0.0]], [[2.0, 0.0]]])
    rollout = rollout_of(features, rewards=torch.tensor([[3.0, 4.0]]))
    learned = 3.0 + 0.5 * 4.0 + 0.25 * -20.0
    assert objective("return")(rollout).item() == pytest.approx(learned)
    assert objective("0.5 * return + 2 * (cart > 0)")(rollout).item() == pytest.approx(0.5 * learned + 2 * 1.5)


def test_an_expression_alone_ends_with_the_rollout():
    assert "value" not in objective("cart > 0.3").needs
    assert "value" in objective("return + cart").needs


def test_the_learned_value_guides_where_the_expression_does_not_hold_it():
    rollout = rollout_of(torch.tensor([[[1.0, 0.0]], [[2.0, 0.0]]]), rewards=torch.tensor([[3.0, 4.0]]))
    guide = 0.1 * terminal_value()
    assert objective("cart > 0", guide=guide)(rollout).item() == pytest.approx(1.5 + 0.1 * 0.25 * -20.0)
    with_return = "return + 2 * (cart > 0)"
    assert objective(with_return, guide=guide)(rollout).item() == objective(with_return)(rollout).item()


@pytest.mark.parametrize(("use_value", "needs"), [(None, True), (True, True), (False, False)])
def test_goals_are_guided_where_the_search_may_use_the_value(use_value, needs):
    model = Cart()
    model.labels = SCALES
    goals = {"model": model, "env": EnvConfig(domain="cartpole", task="swingup"), "encode_goal": None}
    goals["planner"] = CEMPlanner(action_dim=1, horizon=3, discount=0.9, terminal_value=use_value)
    pursued, _ = plan_goals("cart > 0.3", (), **goals)
    assert ("value" in pursued.needs) == needs
    assert plan_goals("return", (), **goals)[0] is None


@pytest.mark.parametrize(("horizon", "discount"), [(2, 0.9), (20, 0.99)])
def test_the_guide_is_a_quarter_of_what_the_plan_would_earn_at_the_learned_rate(horizon, discount):
    model = Cart()
    model.labels = SCALES
    planner = CEMPlanner(action_dim=1, horizon=3, goal_horizon=horizon, discount=discount)
    env = EnvConfig(domain="cartpole", task="swingup")
    pursued, _ = plan_goals("0 * cart", (), model=model, env=env, planner=planner, encode_goal=None)
    end = [-0.1 / (1.0 - discount), 0.0]  # its value is that of a reward of one in every step there will be
    rollout = rollout_of(torch.tensor([[[0.0, 0.0]], [end]]))
    beyond = terminal_value()(rollout).item() * (1.0 - discount)  # as far as this rollout discounts its end
    assert pursued(rollout).item() == pytest.approx(0.25 * horizon * beyond)


def test_a_goal_image_draws_the_latent_near_its_own():
    features = torch.tensor([[[0.0, 0.0], [0.9, 0.0]]])
    worth = objective("2 * goal:end.png", encode_goal=lambda path: torch.tensor([len(path) / 7.0]))
    far, near = worth(rollout_of(features)).tolist()
    assert far == pytest.approx(2 * plan_degree(torch.tensor(1.0)).item())
    assert near > 1.8


@pytest.mark.parametrize(
    ("text", "cart", "speed"),
    [("cart -> 0.7", 0.7, None), ("cart_speed -> -0.5", None, -0.5), ("cart_speed -> 0.5 and cart < 9", None, 0.5)],
)
def test_the_search_reaches_what_is_named(text, cart, speed):
    carts, speeds = plan_cart(text)
    if cart is not None:
        assert abs(carts[-1] - cart) < 0.15
    if speed is not None:
        assert abs(speeds[5:] - speed).max() < 0.2


def test_constraints_hold_where_the_objective_pulls_across_them():
    free, _ = plan_cart("cart_speed -> 2.0")
    kept, _ = plan_cart("cart_speed -> 2.0", [plan_constraint(parse_constraints("cart < 0.5", SCALES))])
    assert free.max() > 0.9
    assert kept.max() < 0.5


def test_with_constraints_alone_the_learned_return_stays():
    free, _ = plan_cart()
    kept, _ = plan_cart(constraints=[plan_constraint(parse_constraints("cart > -0.5", SCALES))])
    assert free[-1] < -1.0
    assert -0.5 < kept[-1] < -0.2


def test_a_violation_counts_margins_with_some_distance():
    features = torch.tensor([[[0.2, 0.0], [0.49, 0.0]], [[0.2, 0.0], [1.0, 0.0]]])
    constraint = plan_constraint(parse_constraints("cart < 0.5; cart_speed < 1", SCALES))
    assert constraint(rollout_of(features)).tolist() == pytest.approx([0.0, (0.1 - 0.02) + (0.1 + 1.0)])


def test_what_the_model_does_not_predict_is_refused():
    nodes = [node for _, node in parse_objective("return + cart * cart_speed", SCALES).terms]
    require_labels(nodes, tuple(SCALES))
    with pytest.raises(UserError, match=r"plan for 'cart_speed': it predicts cart$"):
        require_labels(nodes, ("cart",))
    with pytest.raises(UserError, match=r"plan for 'cart': it was trained without named quantities"):
        require_labels(nodes, ())


def test_a_constant_asks_nothing_of_the_model():
    constant = objective("3")
    rollout = rollout_of(torch.tensor([[[1.0, 0.0]], [[2.0, 0.0]]]))
    rollout.model.probe = rollout.model.label_names = None
    assert constant.needs == () and constant(rollout).shape == (1,)


def test_terms_of_the_planner_mix_with_expressions():
    mixed = objective("cart > 0.3") + 0.1 * learned_return()
    assert isinstance(mixed, Objective) and mixed.needs_states


@pytest.mark.parametrize(("objective", "constraints"), [(5, ()), (None, ["cart < 0.5"]), (None, ("cart < 0.5", "a"))])
def test_what_is_neither_text_nor_function_is_refused_at_once(objective, constraints):
    model = Cart()
    model.labels = SCALES
    with pytest.raises(UserError, match="functions? of rollouts"):
        plan_goals(
            objective,
            constraints,
            model=model,
            env=EnvConfig(domain="cartpole"),
            planner=CEMPlanner(action_dim=1, horizon=2),
            encode_goal=lambda path: torch.zeros(1),
        )
