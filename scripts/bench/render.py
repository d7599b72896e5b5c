"""`benchmark.py render`: milliseconds per frame in each render quality, and the change of the picture.

The change is the mean absolute difference of a pixel to quality `exact`, on a scale of 0 to 255.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.report import format_number, format_table, write_json
from latentplan.config import RENDER_QUALITIES, EnvConfig
from latentplan.config.checks import at_least
from latentplan.config.files import DOMAINS, compose
from latentplan.config.parsing import option, require_known

if TYPE_CHECKING:
    import numpy as np

REPEATS = 3  # timed renderings of each state


@dataclass(frozen=True)
class Request:
    """Flags of `benchmark.py render`.

    Attributes:
        domains: Domains of `dm_control.suite`.
        frames: Frames per domain and quality.
        json: Result as JSON.
    """

    domains: tuple[str, ...] = option(("walker", "cheetah", "cartpole"), separator=",")
    frames: int = 30
    json: Path | None = option(None, metavar="FILE", is_output=True)

    def __post_init__(self) -> None:
        at_least(self, frames=1)
        require_known("domain", self.domains, DOMAINS)


def run(request: Request) -> int:
    """Renders the same states in every quality and compares times and pictures."""
    from latentplan.envs import render_info

    info = render_info()
    print(f"pictures by {info['renderer']} (MUJOCO_GL={info['backend']}, mujoco {info['mujoco']})", flush=True)
    measured = {
        domain: measure_qualities(compose({}, {"env": {"domain": domain}}, "cpu").env, request.frames)
        for domain in request.domains
    }
    rows = [
        [f"{domain}, {quality}", format_number(facts["frame_ms"], 2), format_number(facts["pixel_change"], 2)]
        for domain, qualities in measured.items()
        for quality, facts in qualities.items()
    ]
    print(format_table(["64 x 64", "ms per frame", "mean pixel change / 255"], rows))
    write_json(request.json, {"render": info, "frames": request.frames, "domains": measured})
    return 0


def measure_qualities(config: EnvConfig, num_frames: int) -> dict[str, dict[str, Any]]:
    """Median time per frame, and mean absolute change of a pixel (in 1/255) to `exact`, by quality.

    Args:
        config: Settings of the environment; its own render quality is replaced.
        num_frames: Number of rendered states, the same states in every quality.
    """
    import numpy as np

    measured, exact = {}, None
    for quality in RENDER_QUALITIES:
        frame_ms, frames = _render_episode(dataclasses.replace(config, render_quality=quality), num_frames)
        exact = frames if exact is None else exact  # `exact` comes first
        change = float(np.abs(frames.astype(np.int16) - exact.astype(np.int16)).mean())
        measured[quality] = {"frame_ms": frame_ms, "pixel_change": change}
    return measured


def _render_episode(config: EnvConfig, num_frames: int) -> tuple[float, np.ndarray]:
    """Median milliseconds per frame, and the frames of an episode of random actions (the same in every quality)."""
    import numpy as np

    from latentplan.envs import make_env

    env, rng = make_env(config, seed=0), np.random.default_rng(0)
    frames, milliseconds = [], []
    try:
        env.reset(seed=0)
        for _ in range(num_frames):
            frame, _, terminated, truncated, _ = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
            frames.append(frame)
            for _ in range(REPEATS):
                started = time.perf_counter()
                env.render()
                milliseconds.append(1000.0 * (time.perf_counter() - started))
            if terminated or truncated:
                env.reset(seed=len(frames))
    finally:
        env.close()
    return float(np.median(milliseconds)), np.stack(frames)
