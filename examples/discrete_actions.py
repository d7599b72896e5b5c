"""Train with discrete actions, from pictures alone: keep a paddle that moves left, stays or moves right below a ball.

Prints the mean return of planned, acted and random actions in episodes of 30 steps, in which five balls fall.
"""

import sys

import gymnasium
import numpy as np

from latentplan import load_agent
from latentplan.config import (
    CollectionConfig,
    Config,
    EnvConfig,
    EvaluationConfig,
    LearningConfig,
    ModelConfig,
    PlannerConfig,
    RunConfig,
)
from latentplan.envs import wrap_user_env
from latentplan.evaluation import evaluate_agent
from latentplan.training import train

CELLS = 6  # rows and columns


class Follow(gymnasium.Env):
    """Balls fall one row per step, each from a random column; the paddle in the last row moves one column per step."""

    observation_space = gymnasium.spaces.Box(0, 255, (CELLS, CELLS, 3), np.uint8)
    action_space = gymnasium.spaces.Discrete(3, start=-1)  # left, stay, right

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """The first picture, with the paddle in a random column."""
        super().reset(seed=seed)
        self.paddle = int(self.np_random.integers(CELLS))
        self._drop()
        return self.render(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Moves paddle and ball; the reward is 1 where the paddle is below the ball, else 0."""
        self.paddle = int(np.clip(self.paddle + action, 0, CELLS - 1))
        reward = float(self.column == self.paddle)
        self.row += 1
        if self.row == CELLS:
            self._drop()
        return self.render(), reward, False, False, {}

    def render(self) -> np.ndarray:
        """The picture, one pixel per cell: a red ball and a green paddle."""
        picture = np.zeros((CELLS, CELLS, 3), np.uint8)
        picture[self.row, self.column, 0] = picture[CELLS - 1, self.paddle, 1] = 255
        return picture

    def _drop(self) -> None:
        self.row, self.column = 0, int(self.np_random.integers(CELLS))


def make_env() -> gymnasium.Env:
    """The environment in episodes of five balls."""
    return gymnasium.wrappers.TimeLimit(Follow(), 5 * CELLS)


def main(out: str = ".", frames: str = "1000", seed: str = "0") -> None:
    """Trains for some minutes, and evaluates."""
    config = Config(
        env=EnvConfig(action_repeat=1),
        model=ModelConfig(deter_dim=32, hidden_dim=32, encoder_channels=(8, 8, 8)),
        planner=PlannerConfig(horizon=5, num_samples=64, num_elites=8),
        learning=LearningConfig(
            batch_size=8,
            sequence_length=8,
            imagination_horizon=8,
            imagination_starts=64,
            model_learning_rate=3e-3,
            behaviour_learning_rate=1e-3,
        ),
        collection=CollectionConfig(
            prefill_decisions=300, round_decisions=100, updates_per_decision=1.0, overlap=False
        ),
        evaluation=EvaluationConfig(every_frames=500, video=False),
        run=RunConfig(frames=int(frames), threads=1, seed=int(seed), run_dir=f"{out}/follow"),
    )
    train(config, make_env=make_env)
    for mode in ("planner", "actor", "random"):
        env = wrap_user_env(make_env())
        played = evaluate_agent(load_agent(f"{out}/follow", mode), env, seed=0, episodes=20)
        print(f"{mode}: mean return {played['mean_return']:.1f} of 30")


if __name__ == "__main__":
    main(*sys.argv[1:])  # folder of the run's folder, frames and seed
