"""The durations of decisions and plans: measured on this machine, or drawn from a given distribution."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from latentplan.config import UserError, derive_seed

MEASURED = "measured"
_FORMATS = 'a JSON list of milliseconds, {"decision_ms": [...]}, or one number per line'
_MAX_MS = 1e9  # eleven days

Milliseconds = NDArray[np.float64]
Charge = Callable[[float], float]  # from measured milliseconds to charged milliseconds


@dataclass(frozen=True)
class Latency:
    """The durations that the virtual clock charges.

    Attributes:
        name: `measured`, or the file that the durations came from.
        decision_ms: Durations of decisions, (duration,); None charges the measured durations.
        plan_ms: Durations of plans that are computed beside the decisions, (duration,). Given durations count from the
            frame that the plan begins with, measured durations from the request of the plan. None charges the measured
            durations.
    """

    name: str = MEASURED
    decision_ms: Milliseconds | None = None
    plan_ms: Milliseconds | None = None

    @property
    def is_replayed(self) -> bool:
        """Whether durations are drawn from a distribution, so that results repeat exactly."""
        return self.decision_ms is not None

    def charges(self, seed: int) -> tuple[Charge, Charge]:
        """The charges of decisions and of plans in an episode: two random streams that depend on the seed alone."""
        decision = _make_charge(self.decision_ms, derive_seed(seed, "decision_ms"))
        return decision, _make_charge(self.plan_ms, derive_seed(seed, "plan_ms"))


def read_latency(text: str) -> Latency:
    """The latency that `--latency` names: `measured`, or a file of milliseconds.

    The `decision_ms` of a file without `plan_ms` hold for plans too.

    Raises:
        UserError: The file cannot be read, or does not hold durations.
    """
    if text == MEASURED:
        return Latency()
    try:
        content = _parse(Path(text).read_text())
    except OSError as error:
        raise UserError(f"--latency {text}: {error.strerror}; give {MEASURED!r} or a file of milliseconds") from None
    except (ValueError, RecursionError):
        raise UserError(f"--latency {text}: not a file of milliseconds; write {_FORMATS}") from None
    durations = content if isinstance(content, dict) else {"decision_ms": content}
    unknown = [name for name in durations if name not in ("decision_ms", "plan_ms")]
    if unknown or "decision_ms" not in durations:
        raise UserError(f"--latency {text}: the keys are decision_ms and, if plans differ, plan_ms; got {unknown}")
    decision_ms = _check_durations(text, "decision_ms", durations["decision_ms"])
    plan_ms = _check_durations(text, "plan_ms", durations["plan_ms"]) if "plan_ms" in durations else decision_ms
    return Latency(text, decision_ms, plan_ms)


def _make_charge(durations: Milliseconds | None, seed: int) -> Charge:
    if durations is None:
        return lambda measured_ms: measured_ms
    rng, known = np.random.default_rng(seed), durations
    return lambda measured_ms: float(rng.choice(known))


def _parse(text: str) -> Any:
    """The content of a file of durations, as JSON or as one number per line."""
    try:
        content = json.loads(text)
    except json.JSONDecodeError:
        return [float(line) for line in text.splitlines() if line.strip()]
    return content if isinstance(content, list | dict) else [content]


def _check_durations(text: str, name: str, values: Any) -> Milliseconds:
    if not isinstance(values, list) or not values:
        raise UserError(f"--latency {text}: {name} must be a list of at least one number; write {_FORMATS}")
    for value in values:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not 0 <= value <= _MAX_MS:  # NaN is in no interval
            raise UserError(f"--latency {text}: {name} must lie in 0 to {_MAX_MS:g}, got {value!r}")
    return np.asarray(values, dtype=np.float64)
