"""Draws the film of the README: `python -m scripts.bench.readme_film docs/walker.webp`.

The shipped walker plays with its planner; on the left is the camera, on the right the decoded last state of the plan
that the walker executes. Every decision of the film is planned (`surprise_limit=None`), so that each has a picture.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from PIL import Image

from latentplan import load_agent
from latentplan.config import EnvConfig
from latentplan.envs import make_env
from latentplan.reporting.film import PANEL_SIZE, compose_frame

FIRST, LAST = 80, 190  # decisions of the film, after the walker has stood up and begun to walk
QUALITY = 60  # of the WebP encoder, in [0, 100]


def draw_film(path: Path) -> int:
    """Writes decisions `FIRST` to `LAST` as an endless animated WebP in real time; returns the number of pictures."""
    agent: Any = load_agent("checkpoints/walker-walk", surprise_limit=None)
    env = make_env(EnvConfig(domain="walker", task="walk", render_quality="exact"))
    frame, _ = env.reset(seed=0)
    agent.seed(0)
    earned, pictures = 0.0, []
    for decision in range(LAST):
        action = agent.act(frame)
        if decision >= FIRST:
            camera, imagined = env.render_large(PANEL_SIZE), agent.imagine()
            line = f"return {earned:.0f}    step {decision}"
            pictures.append(Image.fromarray(compose_frame(camera, imagined, [line], horizon=agent.steps_ahead)))
        frame, reward, *_ = env.step(action)
        earned += reward
    milliseconds = round(1000 / env.metadata["render_fps"])
    env.close()
    settings = {"duration": milliseconds, "loop": 0, "quality": QUALITY, "method": 6}
    pictures[0].save(path, format="WEBP", save_all=True, append_images=pictures[1:], **settings)
    return len(pictures)


if __name__ == "__main__":
    target = Path(sys.argv[1])
    print(f"{draw_film(target)} pictures, {target.stat().st_size / 1e6:.2f} MB in {target}")
