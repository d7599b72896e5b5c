"""A task that is learned within seconds, for measurements that start and end many runs.

A dot in a picture is pushed sideways by actions; the reward is 1 in the middle and 0 at the border.
"""

from __future__ import annotations

import contextlib
import random
import time
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np

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

EVERY_FRAMES = 600  # between evaluations
ROUND_FRAMES = 15


class Dot(gymnasium.Env[np.ndarray, np.ndarray]):
    """A dot in a picture of 16 x 16; episodes last for 20 steps.

    Attributes:
        triggers: Folder whose files `exception` and `hang` make the next step fail; None for no faults.
    """

    observation_space = gymnasium.spaces.Box(0, 255, (16, 16, 3), np.uint8)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    triggers: ClassVar[Path | None] = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Puts the dot anywhere."""
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-1.0, 1.0), 0
        return self._picture(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Pushes the dot."""
        if self.triggers is not None:
            if take(self.triggers / "exception"):
                raise ZeroDivisionError("the environment fails on purpose")
            if take(self.triggers / "hang"):
                time.sleep(1e6)
        self.place = float(np.clip(self.place + 0.2 * action[0], -1.0, 1.0))
        self.steps += 1
        return self._picture(), 1.0 - abs(self.place), False, self.steps == 20, {}

    def _picture(self) -> np.ndarray:
        picture = np.zeros((16, 16, 3), np.uint8)
        picture[:, round(7.5 + 7.0 * self.place)] = 255
        return picture


class FaultyDot:
    """Makes dots that fail when a file in a folder asks for it; picklable.

    Args:
        triggers: The folder.
    """

    def __init__(self, triggers: Path) -> None:
        self.triggers = triggers

    def __call__(self) -> Dot:
        """An environment."""
        Dot.triggers = self.triggers
        return Dot()


def take(trigger: Path) -> bool:
    """Whether a file is there, which is then removed."""
    try:
        trigger.unlink()
    except FileNotFoundError:
        return False
    return True


def toy_config(folder: Path, frames: int, *, overlap: bool, every_frames: int = EVERY_FRAMES) -> Config:
    """Settings of a tiny run on one thread."""
    sizes = {"deter_dim": 16, "hidden_dim": 16, "encoder_channels": (4, 4), "decoder_channels": 2, "num_bins": 15}
    return Config(
        env=EnvConfig(action_repeat=1),
        model=ModelConfig(**sizes),  # type: ignore[arg-type]
        planner=PlannerConfig(
            horizon=2, num_samples=8, num_elites=2, num_iterations=1, warm_start_iterations=1, num_policy_samples=2
        ),
        learning=LearningConfig(batch_size=4, sequence_length=5, imagination_horizon=3, imagination_starts=8),
        collection=CollectionConfig(
            prefill_decisions=45, round_decisions=ROUND_FRAMES, updates_per_decision=0.4, overlap=overlap
        ),
        evaluation=EvaluationConfig(every_frames=every_frames, episodes=1, final_episodes=2, video=False, report=False),
        run=RunConfig(frames=frames, device="cpu", threads=1, run_dir=str(folder)),
    )


def list_children(process: int) -> list[int]:
    """The processes that a process has started; none if it has ended."""
    try:
        tasks = list(Path(f"/proc/{process}/task").iterdir())
        return [int(child) for task in tasks for child in (task / "children").read_text().split()]
    except OSError:
        return []


def find_worker(process: int) -> int | None:
    """The collection process of a trainer; None while there is none."""
    for child in list_children(process):
        with contextlib.suppress(OSError):
            if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text():
                return child
    return None


def flip_bit(path: Path, rng: random.Random) -> bytes:
    """Flips one bit anywhere in a file, and returns what the file held before."""
    before = path.read_bytes()
    content = bytearray(before)
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)
    return before
