"""Learn the dynamics of gymnasium's `Pendulum-v1` from random transitions, and plan in the learned network.

Prints the mean return of random actions and of plans; the highest possible return is 0.
"""

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn

from latentplan.planning import CEMPlanner, ModelPredictiveController


class LearnedModel(nn.Sequential):
    """Predicts the next observation (rows, 3) and the reward (rows,) of an action (rows, 1)."""

    def __init__(self, scale: Tensor) -> None:
        super().__init__(nn.Linear(4, 64), nn.SiLU(), nn.Linear(64, 64), nn.SiLU(), nn.Linear(64, 4))
        self.scale = scale  # typical size of the change of each observed number, and of the reward, (4,)

    def step(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The next observation and the reward; a planner needs no other method."""
        prediction = self.scale * self(torch.cat([state, action], dim=1))
        return state + prediction[:, :3], prediction[:, 3]


def play(seed: int, controller: ModelPredictiveController | None = None) -> Tensor:
    """Transitions of an episode, (step, 8): observation, action (random without a controller), next, reward."""
    env, transitions, over = gymnasium.make("Pendulum-v1"), [], False
    obs, _ = env.reset(seed=seed)
    while not over:
        action = 2 * torch.rand(1) - 1 if controller is None else controller.act(torch.tensor(obs)[None])[0]
        next_obs, reward, _, over, _ = env.step(2 * action.numpy())  # torques lie in [-2, 2], actions in [-1, 1]
        transitions.append([*obs, *action, *next_obs, reward])
        obs = next_obs
    return torch.tensor(np.array(transitions), dtype=torch.float32)


def main() -> None:
    """Collects random transitions, learns, plans, and prints both returns."""
    torch.manual_seed(0)
    data = torch.cat([play(seed) for seed in range(25)])
    obs, action, next_obs, reward = data.split([3, 1, 3, 1], dim=1)
    model = LearnedModel(torch.cat([next_obs - obs, reward], dim=1).std(dim=0))
    optimizer = torch.optim.Adam(model.parameters(), lr=2e-3)
    for _ in range(1500):
        rows = torch.randint(len(data), (256,))
        predicted = torch.column_stack(model.step(obs[rows], action[rows]))
        optimizer.zero_grad()
        ((predicted - data[rows, 4:]) / model.scale).square().mean().backward()
        optimizer.step()
    planner = CEMPlanner(action_dim=1, horizon=20, num_samples=200, num_iterations=3, noise_beta=1.0)
    planned = torch.cat([play(seed, ModelPredictiveController(planner, model)) for seed in range(3)])
    print(f"random actions: return {reward.sum() / 25:.0f}\nplans: return {planned[:, -1].sum() / 3:.0f}")


if __name__ == "__main__":
    main()
