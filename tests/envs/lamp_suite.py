"""A suite with one domain: a factory, to be registered in the table of suites."""

import gymnasium
import numpy as np

from latentplan.envs import wrap_user_env


class Lamp(gymnasium.Env):
    """A lamp whose brightness the action turns up and down; the reward is the brightness, in [0, 1]."""

    observation_space = gymnasium.spaces.Box(0, 255, (32, 32, 3), np.uint8)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.brightness, self.num_steps = self.np_random.uniform(), 0
        return self._picture(), {}

    def step(self, action):
        self.brightness = float(np.clip(self.brightness + 0.1 * action[0], 0.0, 1.0))
        self.num_steps += 1
        return self._picture(), self.brightness, False, self.num_steps == 40, {}

    def _picture(self):
        return np.full((32, 32, 3), round(255 * self.brightness), np.uint8)


def make(config, seed):
    assert (config.domain, config.task) in {("lamp", None), ("lamp", "bright")}
    return wrap_user_env(Lamp(), config.action_repeat, seed)
