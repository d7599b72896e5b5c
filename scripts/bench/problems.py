"""Control problems on which planners are compared: their true dynamics and costs, in torch, for rows of states.

`PROBLEMS` maps `pendulum`, `navigation` and `lq` to a `ControlProblem`. A comparison takes these parts of it:

    problem = PROBLEMS["navigation"]
    problem.model()                 FunctionModel with reward = -cost; gradients pass through it
    problem.start([0, 1, 2])        start states of three seeds, (3, state)
    problem.dynamics(state, action) next states, (rows, state), from action (rows, action)
    problem.cost(state, action)     costs of the step, (rows,), of the state before the step
    problem.action_dim, problem.action_low, problem.action_high, problem.horizon, problem.num_steps
    problem.run(act, seeds)         total cost (seeds,) of `num_steps` decisions in the true dynamics;
                                    act(state (seeds, state)) returns the actions (seeds, action)
    problem.lower_bound(seeds)      a cost that no controller can beat, (seeds,); 0 where none is known

A seed sets the start only; a planner's random numbers have their own seed. Every start of a problem costs about the
same. Settings are chosen on seeds 100 to 119, and results are reported on seeds 0 to 19.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from latentplan.planning import FunctionModel

Dynamics = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class ControlProblem:
    """A problem of control: from a start, act for `num_steps` decisions at the lowest total cost.

    Attributes:
        name: Name of the problem.
        action_dim: Numbers in an action.
        action_low: Lowest action, the same in every dimension.
        action_high: Highest action, the same in every dimension.
        horizon: Steps that a plan looks ahead.
        num_steps: Decisions of a run.
        dynamics: `dynamics(state (rows, state), action (rows, action)) -> next_state`.
        cost: `cost(state, action) -> (rows,)`, at least 0.
        draw_start: `draw_start(generator) -> (state,)`, float32.
        bound: `bound(start (rows, state), num_steps) -> (rows,)`, a lower bound of the total cost; None is 0.
    """

    name: str
    action_dim: int
    action_low: float
    action_high: float
    horizon: int
    num_steps: int
    dynamics: Dynamics
    cost: Dynamics
    draw_start: Callable[[torch.Generator], Tensor]
    bound: Callable[[Tensor, int], Tensor] | None = None

    def model(self) -> FunctionModel:
        """Returns the true dynamics as a model whose reward is the negative cost."""
        return FunctionModel(self.dynamics, lambda state, action: -self.cost(state, action))

    def start(self, seeds: Sequence[int]) -> Tensor:
        """Returns the start of each seed, (seeds, state)."""
        return torch.stack([self.draw_start(torch.Generator().manual_seed(seed)) for seed in seeds])

    @torch.no_grad()
    def run(self, act: Callable[[Tensor], Tensor], seeds: Sequence[int]) -> Tensor:
        """Returns the total cost of each run, (seeds,), of a controller in the true dynamics.

        Args:
            act: `act(state (seeds, state)) -> action (seeds, action)`; actions are clamped to the bounds.
            seeds: Seeds of the starts, all run at once.
        """
        state, total = self.start(seeds), torch.zeros(len(seeds))
        for _ in range(self.num_steps):
            action = act(state).to(state).clamp(self.action_low, self.action_high)
            total = total + self.cost(state, action)
            state = self.dynamics(state, action)
        return total

    def lower_bound(self, seeds: Sequence[int]) -> Tensor:
        """Returns a total cost that no controller can beat, (seeds,); 0 where no better bound is known."""
        start = self.start(seeds)
        return torch.zeros(len(seeds)) if self.bound is None else self.bound(start, self.num_steps)


def pendulum() -> ControlProblem:
    """Returns the swing-up of a pendulum whose motor is too weak to lift it directly.

    State: angle from upright in radians and speed in radians per second. A rod of mass 1 and length 1 turns under
    gravity 10, in steps of 0.05 s, at speeds of at most 8. The action is a torque in [-2, 2]. The cost of a step is
    angle² + 0.1 speed² + 0.001 torque², the angle taken in (-pi, pi]. A run starts at the bottom with speed 1, each up
    to 0.01 off. A plan of 20 steps ends before the pendulum is up. From starts that are further off some runs find by
    chance another swing that costs 220, which says nothing of the planner.
    """

    def dynamics(state: Tensor, action: Tensor) -> Tensor:
        angle, speed = state.unbind(dim=1)
        speed = (speed + 0.05 * (15.0 * torch.sin(angle) + 3.0 * action[:, 0])).clamp(-8.0, 8.0)
        return torch.stack([angle + 0.05 * speed, speed], dim=1)

    def cost(state: Tensor, action: Tensor) -> Tensor:
        angle, speed = state.unbind(dim=1)
        angle = torch.atan2(torch.sin(angle), torch.cos(angle))
        return angle.square() + 0.1 * speed.square() + 0.001 * action[:, 0].square()

    def draw_start(generator: torch.Generator) -> Tensor:
        return torch.tensor([math.pi, 1.0]) + _spread(2, 0.01, generator)

    return ControlProblem("pendulum", 1, -2.0, 2.0, 20, 100, dynamics, cost, draw_start)


OBSTACLES = ((0.0, 0.0), (-1.5, 0.5), (0.5, -1.5))
OBSTACLE_COST, OBSTACLE_RADIUS = 17.0, 0.25


def navigation() -> ControlProblem:
    """Returns the way of a point to a goal past three soft obstacles, one of them on the straight line.

    State: position (x, y). A step moves the point by 0.35 action, and the two numbers of the action lie in [-1, 1]. A
    run starts at (-2, -2), up to 0.05 off, and the goal is (2, 2). The cost of a step is the distance to the goal, plus
    17 exp(-d² / (2 * 0.25²)) for each obstacle at distance d, plus 0.01 |action|². The obstacle at the origin can be
    passed on both sides, so the mean of good plans may lead through it.
    """
    obstacles, goal = torch.tensor(OBSTACLES), torch.tensor([2.0, 2.0])

    def dynamics(state: Tensor, action: Tensor) -> Tensor:
        return state + 0.35 * action

    def cost(state: Tensor, action: Tensor) -> Tensor:
        squares = (state[:, None] - obstacles).square().sum(dim=2)
        hills = OBSTACLE_COST * torch.exp(-squares / (2 * OBSTACLE_RADIUS**2))
        # The tiny number keeps the gradient finite at the goal.
        distance = ((state - goal).square().sum(dim=1) + 1e-12).sqrt()
        return distance + hills.sum(dim=1) + 0.01 * action.square().sum(dim=1)

    def draw_start(generator: torch.Generator) -> Tensor:
        return torch.tensor([-2.0, -2.0]) + _spread(2, 0.05, generator)

    return ControlProblem("navigation", 2, -1.0, 1.0, 20, 40, dynamics, cost, draw_start)


def linear_quadratic() -> ControlProblem:
    """Returns a random linear system with a quadratic cost, and many actions.

    The system s' = A s + B a is drawn once: A is Gaussian, scaled to the spectral radius 1, and B is Gaussian with a
    standard deviation of 0.7 / sqrt(action_dim). Actions lie in [-1, 1]. The cost of a step is |s|² + 0.1 |a|². A run
    starts in a random direction, so far away that the optimum without bounds on the actions is 36. This optimum, by
    Riccati's recursion, is the lower bound.
    """
    num_states, action_dim, num_steps = 60, 30, 20
    draw = torch.Generator().manual_seed(0)
    matrix = torch.randn(num_states, num_states, generator=draw)
    transition = matrix / torch.linalg.eigvals(matrix).abs().max()
    control = 0.7 * torch.randn(num_states, action_dim, generator=draw) / math.sqrt(action_dim)

    def dynamics(state: Tensor, action: Tensor) -> Tensor:
        return state @ transition.T + action @ control.T

    def cost(state: Tensor, action: Tensor) -> Tensor:
        return state.square().sum(dim=1) + 0.1 * action.square().sum(dim=1)

    def bound(start: Tensor, num_steps: int) -> Tensor:
        a, b, eye = transition.double(), control.double(), torch.eye(num_states).double()
        matrix = torch.zeros_like(a)
        for _ in range(num_steps):
            gain = torch.linalg.solve(0.1 * torch.eye(action_dim).double() + b.T @ matrix @ b, b.T @ matrix @ a)
            matrix = eye + a.T @ matrix @ (a - b @ gain)
        return torch.einsum("ri,ij,rj->r", start.double(), matrix, start.double()).float()

    def draw_start(generator: torch.Generator) -> Tensor:
        direction = torch.randn(num_states, generator=generator)
        return direction * (36.0 / bound(direction[None], num_steps)).sqrt()

    return ControlProblem("lq", action_dim, -1.0, 1.0, 10, num_steps, dynamics, cost, draw_start, bound)


def _spread(size: int, width: float, generator: torch.Generator) -> Tensor:
    return width * (2 * torch.rand(size, generator=generator) - 1)


PROBLEMS = {problem.name: problem for problem in (pendulum(), navigation(), linear_quadratic())}
