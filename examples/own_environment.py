"""Train in an environment of your own, from pictures alone: push a dot to the middle; prints mean returns."""

import sys
from tempfile import mkdtemp

import gymnasium
import numpy as np

from latentplan import load_agent
from latentplan.config import CollectionConfig, Config, LearningConfig, ModelConfig, RunConfig
from latentplan.envs import wrap_user_env
from latentplan.evaluation import evaluate_agent
from latentplan.training import train


class Dot(gymnasium.Env):
    """A dot in a picture of 16 x 16 pixels."""

    observation_space = gymnasium.spaces.Box(0, 255, (16, 16, 3), np.uint8)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """The first picture."""
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1.0, 1.0)
        return self.render(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Pushes the dot by at most 0.2; the reward is 1 in the middle and 0 at both ends."""
        self.place = float(np.clip(self.place + 0.2 * action[0], -1.0, 1.0))
        return self.render(), 1.0 - abs(self.place), False, False, {}

    def render(self) -> np.ndarray:
        """The picture, uint8 (height, width, 3), with a white column at the place of the dot."""
        row = 255 * np.eye(16, dtype=np.uint8)[round(7.5 + 7.0 * self.place)]
        return np.tile(row[:, None], (16, 1, 3))


def make_env() -> gymnasium.Env:
    """The environment in episodes of 20 steps."""
    return gymnasium.wrappers.TimeLimit(Dot(), 20)


def main(out: str = ".") -> None:
    """Trains for a few seconds, which are enough here, and evaluates."""
    model = ModelConfig(deter_dim=32, hidden_dim=32, encoder_channels=(8, 8, 8))
    learning = LearningConfig(batch_size=8, sequence_length=8, model_learning_rate=3e-3, behaviour_learning_rate=1e-3)
    collection = CollectionConfig(prefill_decisions=200, round_decisions=100, updates_per_decision=1.0, overlap=False)
    run = RunConfig(frames=500, threads=1, run_dir=mkdtemp(prefix="dot-", dir=out))
    result = train(Config(model=model, learning=learning, collection=collection, run=run), make_env=make_env)
    if result.exit_code:  # stopped by Ctrl-C or SIGTERM
        sys.exit(result.exit_code)
    for mode in ("planner", "random"):
        agent, env = load_agent(result.run_dir, mode), wrap_user_env(make_env(), action_repeat=2)
        print(f"{mode}: mean return {evaluate_agent(agent, env, seed=0, episodes=10)['mean_return']:.1f}")


if __name__ == "__main__":  # needed with overlap=True, where a second process imports this file
    main(*sys.argv[1:2])  # folder of the run's folder; the current one unless given
