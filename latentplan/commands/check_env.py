"""`latentplan check-env`: test an environment before an agent learns in it."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from latentplan.commands.flags import overrides
from latentplan.commands.shell import refuse
from latentplan.commands.train import SHORT_FLAGS
from latentplan.config import CollectionConfig, EnvConfig
from latentplan.config.checks import above_zero, at_least, shown
from latentplan.config.env_id import FLAG, import_named, lay_env
from latentplan.config.files import compose
from latentplan.config.parsing import option
from latentplan.config.suites import check_task

if TYPE_CHECKING:
    import numpy as np

ENLARGED = 2  # pixels of the strip for each pixel of a frame


@dataclass(frozen=True)
class Request:
    """The command line of a test.

    Attributes:
        env_id: Environment of gymnasium's registry, as ID or module:ID; the flag may be left out before the id.
        settings: Settings of the environment, as for training.
        decisions: Decisions to play.
        step_timeout_s: Seconds that a reset or a step may take.
        out: Strip of frames over time, .png.
    """

    FIRST = FLAG
    NOTES = (
        "Exit code 0 means that training accepts the environment, 2 that it does not: then there is one line for each "
        "reason. Without an id the environment is the suite's task of --domain and --task."
    )

    env_id: str | None = option(None, metavar="[MODULE:]ID")
    settings: dict[str, Any] = overrides(
        EnvConfig, {key.removeprefix("env."): flag for key, flag in SHORT_FLAGS.items()}, prefix="env."
    )
    decisions: int = 200
    step_timeout_s: float = CollectionConfig.step_timeout_s
    out: Path | None = option(None, metavar="FILE.png", is_output=True)

    def __post_init__(self) -> None:
        at_least(self, decisions=1)
        above_zero(self, "step_timeout_s")
        if self.out is not None and self.out.suffix.lower() != ".png":
            raise ValueError(f"out must end in .png, got {shown(str(self.out))}")
        lay_env(self.settings, self.env_id)


def resolve(request: Request) -> EnvConfig:
    """The settings of the environment that a run with these flags would have."""
    return compose({}, {"env": lay_env(request.settings, request.env_id)}, "cpu").env


def run(request: Request) -> int:
    """Test the environment, print what was found, and return the exit code: 0, or 2 if training refuses it."""
    config = resolve(request)
    if request.env_id is not None:
        import_named(request.env_id)
    from latentplan.training.checks import check_env_settings

    check_env_settings(config)
    from latentplan.envs.conformance import check_environment

    print(f"{config.domain}-{config.task or check_task(config.suite, config.domain)[0]}", flush=True)
    report = check_environment(config, request.decisions, request.step_timeout_s)
    for name, fact in report.facts.items():
        print(f"{name:<14}{fact}")
    for note in report.notes:
        print(f"note: {note}")
    if request.out is not None and report.pictures:
        _write_strip(request.out, report.pictures)
        print(f"{len(report.pictures)} frames, from first to last, are in {request.out}")
    sys.stdout.flush()
    for problem in report.problems:
        refuse(problem)
    print(report.origin, file=sys.stderr, end="")
    if not report.problems:
        print("training accepts this environment")
    return 2 if report.problems else 0


def _write_strip(path: Path, pictures: list[np.ndarray]) -> None:
    """Writes pictures side by side as PNG."""
    import cv2
    import numpy as np

    strip = np.concatenate(pictures, axis=1).repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1)
    path.write_bytes(cv2.imencode(".png", strip[..., ::-1])[1].tobytes())
