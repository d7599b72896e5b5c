"""Train from pictures of two cameras and numbers beside them: push a dot to the middle; prints mean returns."""

import sys
from tempfile import mkdtemp

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

from latentplan import load_agent
from latentplan.config import CollectionConfig, Config, EnvConfig, LearningConfig, ModelConfig, RunConfig
from latentplan.envs import wrap_user_env
from latentplan.evaluation import evaluate_agent
from latentplan.training import train

PICTURE, PUSH = Box(0, 255, (16, 16), np.uint8), Box(-0.2, 0.2, (), np.float32)


class Dot(gymnasium.Env):
    """A dot in a square; the reward is 1 in the middle and 0 in the corners."""

    observation_space = Dict({"side": PICTURE, "above": PICTURE, "speed": Box(-0.2, 0.2, (2,), np.float32)})
    action_space = Dict({"x": PUSH, "y": PUSH})

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """The first observation, with the dot anywhere."""
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1.0, 1.0, 2)
        return self.observe(np.zeros(2)), {}

    def step(self, action: dict) -> tuple[dict, float, bool, bool, dict]:
        """Pushes the dot."""
        before, self.place = self.place, np.clip(self.place + [action["x"], action["y"]], -1.0, 1.0)
        return self.observe(self.place - before), 1.0 - float(np.abs(self.place).mean()), False, False, {}

    def observe(self, speed: np.ndarray) -> dict:
        """Two gray pictures with a white column at a coordinate of the dot, and the speed."""
        side, above = (np.tile(255 * np.eye(16, dtype=np.uint8)[round(7.5 + 7.0 * at)], (16, 1)) for at in self.place)
        return {"side": side, "above": above, "speed": speed.astype(np.float32)}


def main(out: str = ".") -> None:
    """Trains for about two minutes, and evaluates in episodes of 20 steps."""
    env = EnvConfig(action_repeat=2, cameras=("side", "above"), vectors=("speed",))
    model = ModelConfig(deter_dim=32, hidden_dim=32, encoder_channels=(8, 8, 8))
    learning = LearningConfig(batch_size=8, sequence_length=8, model_learning_rate=3e-3, behaviour_learning_rate=1e-3)
    collection = CollectionConfig(prefill_decisions=200, round_decisions=100, updates_per_decision=1.0, overlap=False)
    run = RunConfig(frames=2000, threads=1, run_dir=mkdtemp(prefix="two_cameras-", dir=out))
    config = Config(env=env, model=model, learning=learning, collection=collection, run=run)
    result = train(config, make_env=lambda: gymnasium.wrappers.TimeLimit(Dot(), 20))
    if result.exit_code:  # stopped by Ctrl-C or SIGTERM
        sys.exit(result.exit_code)
    for mode in ("planner", "random"):
        inner = wrap_user_env(gymnasium.wrappers.TimeLimit(Dot(), 20), 2, config=env)
        played = evaluate_agent(load_agent(result.run_dir, mode), inner, seed=0, episodes=10)
        print(f"{mode}: mean return {played['mean_return']:.1f}")


if __name__ == "__main__":
    main(*sys.argv[1:2])  # folder of the run's folder; the current one unless given
