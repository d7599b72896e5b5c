"""The durations that an evaluation in a world that does not wait charges for decisions: `--latency`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from latentplan.config.checks import UserError, shown
from latentplan.config.reading import LARGEST_DATA, read_text

MEASURED = "measured"
_FORMATS = 'a JSON list of milliseconds, {"decision_ms": [...]}, or one number per line'
_MAX_MS = 1e9  # eleven days


def read_durations(text: str) -> tuple[list[float], list[float]] | None:
    """The milliseconds of decisions and of plans that `--latency` names; None for `measured`.

    The `decision_ms` of a file without `plan_ms` hold for plans too.

    Raises:
        UserError: The file cannot be read, or does not hold durations.
    """
    if text == MEASURED:
        return None
    try:
        written = read_text(Path(text), LARGEST_DATA)
    except UserError as error:
        raise UserError(f"--latency: {error}; give {MEASURED!r} or a file of milliseconds") from None
    try:
        content = _parse(written)
    except (ValueError, RecursionError):
        raise UserError(f"--latency {text}: not a file of milliseconds; write {_FORMATS}") from None
    durations = content if isinstance(content, dict) else {"decision_ms": content}
    unknown = [name for name in durations if name not in ("decision_ms", "plan_ms")]
    if unknown or "decision_ms" not in durations:
        raise UserError(
            f"--latency {text}: the keys are decision_ms and, if plans differ, plan_ms; got {shown(unknown)}"
        )
    decision_ms = _check_durations(text, "decision_ms", durations["decision_ms"])
    plan_ms = _check_durations(text, "plan_ms", durations["plan_ms"]) if "plan_ms" in durations else decision_ms
    return decision_ms, plan_ms


def _parse(text: str) -> Any:
    """The content of a file of durations, as JSON or as one number per line."""
    try:
        content = json.loads(text)
    except json.JSONDecodeError:
        return [float(line) for line in text.splitlines() if line.strip()]
    return content if isinstance(content, list | dict) else [content]


def _check_durations(text: str, name: str, values: Any) -> list[float]:
    if not isinstance(values, list) or not values:
        raise UserError(f"--latency {text}: {name} must be a list of at least one number; write {_FORMATS}")
    for value in values:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not 0 <= value <= _MAX_MS:  # NaN is in no interval
            raise UserError(f"--latency {text}: {name} must lie in 0 to {_MAX_MS:g}, got {shown(value)}")
    return [float(value) for value in values]
