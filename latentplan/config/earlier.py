"""Settings that earlier versions had or lacked.

A file or checkpoint that an earlier version saved names every setting that it knew. Of a setting that no longer exists,
the value that had no effect is read and dropped; any other value is refused, because the run that it describes cannot
be repeated. A setting that came later gets the value that stands for what the earlier version did.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from latentplan.config.checks import UserError, shown


class Removed(NamedTuple):
    """A setting that no longer exists.

    Attributes:
        accepted: The value that saved files may still hold: it means what the program does today.
        advice: One sentence that says what to do instead.
    """

    accepted: Any
    advice: str


REMOVED = {
    "planner.start": Removed(
        "shifted",
        "a search starts from the shifted previous plan; raise planner.num_policy_samples to rely more on the policy",
    ),
    "planner.warm_start_variance": Removed(
        "reset", "a warm start resets the variance; lower planner.init_std to search closer to the previous plan"
    ),
    "learning.imitation_scale": Removed(0.0, "scripts/distill.py teaches the actor from the planner"),
    "collection.noise_share": Removed(1.0, "every round is collected with noise of collection.noise_std"),
}

ADDED: dict[str, dict[str, Any]] = {
    "model": {"decoder_layers": 0, "decoder_width": 96},  # 96 of the agents that have layers and name no width
    "planner": {"policy_margin": None},
    "env": {"render_slices": 28},
}


def as_saved(section: str, fields: Mapping[Any, Any]) -> dict[Any, Any]:
    """The settings of a section that a program saved, with the later settings that it did not know."""
    return {**ADDED.get(section, {}), **fields}


def drop_removed(section: str, fields: Mapping[Any, Any]) -> dict[Any, Any]:
    """The settings of a section without those that no longer exist.

    Raises:
        UserError: A removed setting has another value than the one that is still accepted.
    """
    kept = {}
    for name, value in fields.items():
        removed = REMOVED.get(f"{section}.{name}")
        if removed is None:
            kept[name] = value
        elif value != removed.accepted:
            raise UserError(f"{section}.{name} no longer exists, got {shown(value)}: {removed.advice}")
    return kept
