"""Give a trained agent a goal that it was not trained for: the pole hangs down, to the right of the middle.

The shipped agent learned from camera frames to swing the pole up. Prints position and height of the pole over the
last two seconds with and without the goal, and draws the last camera frames of both (`new_goal.png`).
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from latentplan import load_agent
from latentplan.config import EnvConfig
from latentplan.envs import make_env

CHECKPOINT = Path(__file__).resolve().parent.parent / "checkpoints" / "cartpole-swingup"
GOAL = "upright < -0.9 and cart -> 0.8"  # cosine of the pole's angle, and metres


def play(objective: str | None) -> tuple[dict[str, float], np.ndarray]:
    """Means of the true quantities over the last 25 decisions of an episode, and its last picture."""
    env = make_env(EnvConfig(domain="cartpole", task="swingup", action_repeat=8))
    agent = load_agent(CHECKPOINT)
    agent.seed(0)
    agent.set_objective(objective)  # None is the trained task
    (frame, _), over, quantities = env.reset(seed=0), False, []
    while not over:
        frame, _, terminated, truncated, info = env.step(agent.act(frame))
        over = terminated or truncated
        quantities.append(info["labels"])
    picture = env.render_large(256)
    env.close()
    return dict(zip(env.labels, np.mean(quantities[-25:], axis=0), strict=True)), picture


def main(out: str = ".") -> None:
    """Plays with and without the goal, prints the reached quantities and draws the last frames."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    for column, (name, objective) in enumerate({"trained task": None, "new goal": GOAL}.items(), start=1):
        axes = figure.add_subplot(1, 2, column)
        reached, picture = play(objective)
        print(f"{name}: cart {reached['cart']:.2f} m, upright {reached['upright']:.2f}")
        axes.imshow(picture)
        axes.set(title=name, xticks=[], yticks=[])
    figure.savefig(f"{out}/new_goal.png")


if __name__ == "__main__":
    main(*sys.argv[1:2])  # folder of the picture; the current one unless given
