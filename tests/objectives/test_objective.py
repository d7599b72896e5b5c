"""The planner maximises expressions over predicted quantities, and keeps a distance from constraints."""

from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from latentplan.config import EnvConfig, UserError
from latentplan.objectives.box import planning_degree
from latentplan.objectives.goal_image import read_goal_image
from latentplan.objectives.objective import (
    build_constraint,
    build_goals,
    build_objective,
    require_labels,
)
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
    """A cart pushed by the action, with its quantities in its state; the reward grows to the left."""

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
    return build_objective(parse_objective(text, SCALES), frames_per_step, learned, guide, encode_goal)


def plan_cart(text=None, constraints=(), start=(0.0, 0.0), **options):
    """Cart positions and speeds along the plan for a goal, (step,) each."""
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


def test_build_objective_sums_discounted_degrees_of_a_rollout():
    carts = torch.tensor([[0.0, 1.0], [0.5, 1.0], [1.0, 1.0]])[..., None]
    rollout = rollout_of(torch.cat([carts, torch.zeros_like(carts)], dim=-1))
    half, none = planning_degree(torch.tensor([1.0, 2.0])).tolist()
    assert objective("cart > 1.0")(rollout).tolist() == pytest.approx([none + 0.5 * half + 0.25, 1.75])
    assert objective("0.5 * cart", frames_per_step=4)(rollout).tolist() == pytest.approx([1.0, 3.5])
    assert objective("2")(rollout).tolist() == pytest.approx([3.5, 3.5])


def test_planning_degree_rises_wherever_a_clause_does_not_hold():
    degrees = planning_degree(torch.linspace(20.0, -1.0, 300))
    assert bool((degrees.diff()[:280] > 0).all()) and degrees.min() > 0
    assert bool((degrees[-14:] == 1.0).all())
    assert bool(planning_degree(torch.tensor(float("nan"))).isnan())


def test_build_objective_weights_the_learned_return():
    features = torch.tensor([[[1.0, 0.0]], [[2.0, 0.0]]])
    rollout = rollout_of(features, rewards=torch.tensor([[3.0, 4.0]]))
    learned = 3.0 + 0.5 * 4.0 + 0.25 * -20.0
    assert objective("return")(rollout).item() == pytest.approx(learned)
    assert objective("0.5 * return + 2 * (cart > 0)")(rollout).item() == pytest.approx(0.5 * learned + 2 * 1.5)


def test_build_objective_needs_a_value_only_for_the_learned_return():
    assert "value" not in objective("cart > 0.3").needs
    assert "value" in objective("return + cart").needs


def test_build_objective_adds_the_guide_when_expression_has_no_return():
    rollout = rollout_of(torch.tensor([[[1.0, 0.0]], [[2.0, 0.0]]]), rewards=torch.tensor([[3.0, 4.0]]))
    guide = 0.1 * terminal_value()
    assert objective("cart > 0", guide=guide)(rollout).item() == pytest.approx(1.5 + 0.1 * 0.25 * -20.0)
    with_return = "return + 2 * (cart > 0)"
    assert objective(with_return, guide=guide)(rollout).item() == objective(with_return)(rollout).item()


@pytest.mark.parametrize(("use_value", "needs"), [(None, True), (True, True), (False, False)])
def test_build_goals_uses_the_terminal_value_if_the_planner_allows_it(use_value, needs):
    model = Cart()
    model.labels = SCALES
    goals = {"model": model, "env": EnvConfig(domain="cartpole", task="swingup"), "encode_goal": None}
    goals["planner"] = CEMPlanner(action_dim=1, horizon=3, discount=0.9, terminal_value=use_value)
    pursued, _ = build_goals("cart > 0.3", (), **goals)
    assert ("value" in pursued.needs) == needs
    assert build_goals("return", (), **goals)[0] is None


@pytest.mark.parametrize(("horizon", "discount"), [(2, 0.9), (20, 0.99)])
def test_guide_is_a_quarter_of_the_return_at_the_rate_of_the_value(horizon, discount):
    model = Cart()
    model.labels = SCALES
    planner = CEMPlanner(action_dim=1, horizon=3, goal_horizon=horizon, discount=discount)
    env = EnvConfig(domain="cartpole", task="swingup")
    pursued, _ = build_goals("0 * cart", (), model=model, env=env, planner=planner, encode_goal=None)
    end = [-0.1 / (1.0 - discount), 0.0]  # the value equals a reward of one in every future step
    rollout = rollout_of(torch.tensor([[[0.0, 0.0]], [end]]))
    beyond = terminal_value()(rollout).item() * (1.0 - discount)  # with the discount of this rollout at its end
    assert pursued(rollout).item() == pytest.approx(0.25 * horizon * beyond)


def test_build_objective_rewards_latents_near_the_goal_image():
    features = torch.tensor([[[0.0, 0.0], [0.9, 0.0]]])
    score = objective("2 * goal:end.png", encode_goal=lambda path: torch.tensor([len(path) / 7.0]))
    far, near = score(rollout_of(features)).tolist()
    assert far == pytest.approx(2 * planning_degree(torch.tensor(1.0)).item())
    assert near > 1.8


@pytest.mark.parametrize(
    ("text", "cart", "speed"),
    [("cart -> 0.7", 0.7, None), ("cart_speed -> -0.5", None, -0.5), ("cart_speed -> 0.5 and cart < 9", None, 0.5)],
)
def test_planner_reaches_the_quantities_of_an_expression(text, cart, speed):
    carts, speeds = plan_cart(text)
    if cart is not None:
        assert abs(carts[-1] - cart) < 0.15
    if speed is not None:
        assert abs(speeds[5:] - speed).max() < 0.2


def test_planner_keeps_a_constraint_when_the_objective_conflicts():
    free, _ = plan_cart("cart_speed -> 2.0")
    kept, _ = plan_cart("cart_speed -> 2.0", [build_constraint(parse_constraints("cart < 0.5", SCALES))])
    assert free.max() > 0.9
    assert kept.max() < 0.5


def test_planner_maximises_the_learned_return_when_only_constraints_are_given():
    free, _ = plan_cart()
    kept, _ = plan_cart(constraints=[build_constraint(parse_constraints("cart > -0.5", SCALES))])
    assert free[-1] < -1.0
    assert -0.5 < kept[-1] < -0.2


def test_build_constraint_sums_violations_in_margins_with_a_distance():
    features = torch.tensor([[[0.2, 0.0], [0.49, 0.0]], [[0.2, 0.0], [1.0, 0.0]]])
    constraint = build_constraint(parse_constraints("cart < 0.5; cart_speed < 1", SCALES))
    assert constraint(rollout_of(features)).tolist() == pytest.approx([0.0, (0.1 - 0.02) + (0.1 + 1.0)])


def test_require_labels_refuses_quantities_that_the_model_does_not_predict():
    nodes = [node for _, node in parse_objective("return + cart * cart_speed", SCALES).terms]
    require_labels(nodes, tuple(SCALES))
    with pytest.raises(UserError, match=r"plan for 'cart_speed': it predicts cart$"):
        require_labels(nodes, ("cart",))
    with pytest.raises(UserError, match=r"plan for 'cart': it was trained without named quantities"):
        require_labels(nodes, ())


def test_build_objective_needs_no_probe_when_expression_is_constant():
    constant = objective("3")
    rollout = rollout_of(torch.tensor([[[1.0, 0.0]], [[2.0, 0.0]]]))
    rollout.model.probe = rollout.model.label_names = None
    assert constant.needs == () and constant(rollout).shape == (1,)


def test_build_objective_can_be_added_to_the_learned_return():
    mixed = objective("cart > 0.3") + 0.1 * learned_return()
    assert isinstance(mixed, Objective) and mixed.needs_states


@pytest.mark.parametrize(
    ("objective", "constraints"),
    [(5, ()), (None, ["cart < 0.5"]), (None, ("cart < 0.5", "a")), (None, learned_return())],
)
def test_build_goals_refuses_values_that_are_not_text_or_functions(objective, constraints):
    model = Cart()
    model.labels = SCALES
    with pytest.raises(UserError, match="functions? of rollouts"):
        build_goals(
            objective,
            constraints,
            model=model,
            env=EnvConfig(domain="cartpole"),
            planner=CEMPlanner(action_dim=1, horizon=2),
            encode_goal=lambda path: torch.zeros(1),
        )


def test_blank_text_sets_no_constraint():
    model = Cart()
    model.labels = SCALES
    parts = {"env": EnvConfig(domain="cartpole"), "planner": CEMPlanner(action_dim=1), "encode_goal": None}
    assert build_goals(None, " ; ", model=model, **parts) == (None, ())


@pytest.mark.parametrize(
    ("name", "reason"), [("nothing.png", "does not exist"), ("", "is a folder"), ("a" * 300 + ".png", "cannot be read")]
)
def test_read_goal_image_names_the_file_when_it_cannot_be_read(tmp_path, name, reason):
    with pytest.raises(UserError, match=reason):
        read_goal_image(str(tmp_path / name))


def test_goal_image_may_lie_in_a_folder_whose_name_is_not_utf8(tmp_path):
    folder = tmp_path / "\udcff"
    folder.mkdir()
    picture = np.full((64, 64, 3), 7, np.uint8)
    (folder / "goal.png").write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    assert np.array_equal(read_goal_image(str(folder / "goal.png")), picture)


def test_read_goal_image_gives_opencvs_reason_when_the_image_is_too_large(tmp_path, monkeypatch):
    (tmp_path / "large.png").write_bytes(b"a picture")

    def refuse(content, flags):
        raise cv2.error("(-215:Assertion failed) pixels <= CV_IO_MAX_IMAGE_PIXELS")

    monkeypatch.setattr(cv2, "imdecode", refuse)
    with pytest.raises(UserError, match="CV_IO_MAX_IMAGE_PIXELS"):
        read_goal_image(str(tmp_path / "large.png"))
