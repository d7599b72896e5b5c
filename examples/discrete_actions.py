"""Train with discrete actions: a paddle should stay below a lamp that jumps; prints mean returns, 30 at most."""

import sys
from tempfile import mkdtemp

import gymnasium
import numpy as np

from latentplan import load_agent
from latentplan.config import CollectionConfig, Config, EnvConfig, LearningConfig, ModelConfig, PlannerConfig, RunConfig
from latentplan.envs import wrap_user_env
from latentplan.evaluation import evaluate_agent
from latentplan.training import train

COLUMNS = 5


class Follow(gymnasium.Env):
    """A lamp above, which jumps to a random column at every sixth step, and a paddle below, which moves one column."""

    observation_space = gymnasium.spaces.Box(0, 255, (2, COLUMNS, 3), np.uint8)
    action_space = gymnasium.spaces.Discrete(3, start=-1)  # left, stay, right

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """The first picture, with lamp and paddle in random columns."""
        super().reset(seed=seed)
        self.steps, (self.lamp, self.paddle) = 0, self.np_random.integers(COLUMNS, size=2)
        return self.render(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Moves the paddle, then perhaps the lamp; the reward is 1 where the paddle was below the lamp, else 0."""
        self.steps, self.paddle = self.steps + 1, np.clip(self.paddle + action, 0, COLUMNS - 1)
        reward = float(self.lamp == self.paddle)
        self.lamp = self.lamp if self.steps % 6 else self.np_random.integers(COLUMNS)
        return self.render(), reward, False, self.steps == 30, {}

    def render(self) -> np.ndarray:
        """The picture, one pixel per column in each half: a yellow lamp and a white paddle."""
        columns = np.eye(COLUMNS, dtype=np.uint8)[[self.lamp, self.paddle], :, None]
        return columns * np.array([[[255, 255, 0]], [[255, 255, 255]]], np.uint8)


def main(out: str = ".", frames: str = "1200", seed: str = "0") -> None:
    """Trains for some minutes, and evaluates."""
    env, planner = EnvConfig(action_repeat=1), PlannerConfig(horizon=5, num_samples=48, num_elites=6, num_iterations=3)
    model = ModelConfig(deter_dim=32, hidden_dim=32, encoder_channels=(8, 8, 8))
    rates = {"model_learning_rate": 3e-3, "behaviour_learning_rate": 1e-3, "entropy_scale": 1e-2}
    learning = LearningConfig(batch_size=8, sequence_length=8, imagination_horizon=8, imagination_starts=64, **rates)
    collection = CollectionConfig(prefill_decisions=300, round_decisions=100, updates_per_decision=1.0, overlap=False)
    run = RunConfig(frames=int(frames), threads=1, seed=int(seed), run_dir=mkdtemp(prefix="follow-", dir=out))
    result = train(Config(env, model, planner, learning, collection, run=run), make_env=Follow)
    if result.exit_code:  # stopped by Ctrl-C or SIGTERM
        sys.exit(result.exit_code)
    for mode in ("planner", "actor", "random"):
        agent, inner = load_agent(result.run_dir, mode), wrap_user_env(Follow())
        print(f"{mode}: mean return {evaluate_agent(agent, inner, seed=0, episodes=20)['mean_return']:.1f}")


if __name__ == "__main__":
    main(*sys.argv[1:])  # folder of the run's folder, frames, seed
