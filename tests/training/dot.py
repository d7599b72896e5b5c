"""The environment of the training tests; processes that make it import nothing else from the tests."""

import gymnasium
import numpy as np


class Dot(gymnasium.Env):
    """A dot in a picture of 16 x 16, pushed sideways by actions; the reward is 1 in the middle and 0 at the border."""

    observation_space = gymnasium.spaces.Box(0, 255, (16, 16, 3), np.uint8)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-1.0, 1.0), 0
        return self.picture(), {}

    def step(self, action):
        self.place = float(np.clip(self.place + 0.2 * action[0], -1.0, 1.0))
        self.steps += 1
        return self.picture(), 1.0 - abs(self.place), False, self.steps == 20, {}

    def picture(self):
        picture = np.zeros((16, 16, 3), np.uint8)
        picture[:, round(7.5 + 7.0 * self.place)] = 255
        return picture
