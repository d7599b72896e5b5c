"""Messages between the page and the simulation, as JSON.

The page sends an object with any of these keys: `objective`, `constraint`, `mode` and the names in `SEARCH` (text,
empty for the agent's own), `push` (a force in newtons), `reset` (true) and `picture` (a PNG file in base64, or `camera`
for what the agent sees). It gets objects with one key each: `moment`, `future`, `settings`, `picture` or `refused`.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from latentplan.agents.modes import MODES
from latentplan.config import PlannerConfig, UserError
from latentplan.config.checks import shown
from latentplan.config.parsing import list_settings, raise_unknown, read_values, require_known
from latentplan.config.quantities import QUANTITIES
from latentplan.reporting.page import data_address, encode_png
from latentplan.view.pace import Pace
from latentplan.view.pictures import LARGEST_BYTES, RULE
from latentplan.view.session import MOST_WEIGHTS, PUSH_S, Fan, Future, Moment, Session

SEARCH = ("horizon", "num_samples", "num_iterations", "warm_start_iterations", "deadline_ms")
TEXTS = ("objective", "constraint", "mode")
SHOWN_DIMENSIONS = 2  # of the actions in a fan
_SEARCH_SETTINGS = [setting for setting in list_settings(PlannerConfig) if setting.key in SEARCH]
_DIGITS = 5


def obey(session: Session, text: str) -> list[dict[str, Any]]:
    """Does what a page asks for, and returns the answers for all pages.

    Raises:
        UserError: The request cannot be followed; the session goes on as before.
    """
    request = _read_object(text)
    require_known("request", request, (*TEXTS, *SEARCH, "push", "reset", "picture"))
    force = _read_number("push", request["push"]) if "push" in request else None
    if force is not None:
        session.check_push(force)
    given = {name: value for name, value in request.items() if name in (*TEXTS, *SEARCH)}
    wanted = _changed(session, given) if given else None
    answers: list[dict[str, Any]] = []
    if "picture" in request:
        name = session.pictures.add(_read_picture(session, request["picture"]))
        answers.append(describe_picture(name, session.pictures.contents[name]))
    if wanted is not None:
        try:
            session.change(wanted)
        except UserError:
            if "picture" in request:
                session.pictures.drop_last()
            raise
        answers.append(describe_settings(session))
    if force is not None:
        session.push(force)
    if request.get("reset"):
        session.restart()
    return answers


def describe_settings(session: Session) -> dict[str, Any]:
    """What the controls of a page show."""
    settings, planner = session.settings, dict(session.settings.planner)
    weight = session.weight
    units = {quantity.name: quantity.unit for quantity in QUANTITIES.get(session.domain, ())}
    return {
        "settings": {
            "mode": settings.mode,
            "modes": list(MODES),
            "plans": session.is_planning,
            "searches_here": hasattr(session.agent, "controller"),
            "objective": settings.objective or "",
            "constraint": settings.constraint or "",
            "search": {name: planner.get(name) for name in SEARCH},
            "own": {name: getattr(session.search, name) for name in SEARCH},
            "goal_horizon": session.search.goal_horizon,
            "surprise_limit": getattr(session.agent, "effective_surprise_limit", None),
            "period_ms": 1000.0 * session.period_s,
            "weight": weight,
            "pushed_body": getattr(session.env.unwrapped, "pushed_body", None),
            "push_s": PUSH_S,
            "most_push": None if weight is None else MOST_WEIGHTS * weight,
            "units": units,
            "largest_picture": LARGEST_BYTES,
            "picture_rule": RULE,
        }
    }


def describe_picture(name: str, content: bytes) -> dict[str, Any]:
    """A goal picture that a page can choose."""
    return {"picture": {"name": name, "address": data_address(content)}}


def describe_moment(moment: Moment, pace: Pace) -> dict[str, Any]:
    """One decision, with the pace of the loop."""
    return {
        "moment": {
            "number": pace.num_decisions,
            "episode": moment.episode,
            "decision": moment.decision,
            "total": moment.total_return,
            "frame": data_address(encode_png(moment.frame)),
            "source": moment.source,
            "decision_ms": moment.decision_ms,
            "busy_ms": pace.busy_ms,
            "period_ms": pace.period_ms,
            "rate": pace.rate,
            "late": pace.num_late,
            "surprise": moment.surprise,
            "quantities": moment.quantities,
            "score": moment.score,
            "clauses": moment.clauses,
            "pushed": moment.is_pushed,
        }
    }


def describe_future(moment: Moment, future: Future, pace: Pace) -> dict[str, Any]:
    """What the model imagined at a decision."""
    return {
        "future": {
            "number": pace.num_decisions,
            "source": moment.source,
            "steps": future.steps,
            "num_steps": future.num_steps,
            "picture": data_address(encode_png(future.picture)),
            "rewards": future.rewards,
            "fan": None if future.fan is None else _describe_fan(future.fan),
        }
    }


def write(message: Mapping[str, Any]) -> str:
    """A message as JSON; numbers are rounded, and those that are not finite become null."""
    return json.dumps(_plain(message), allow_nan=False)


def _describe_fan(fan: Fan) -> list[dict[str, Any]]:
    """For the first dimensions of the action: sequences of candidates and elites, and the mean."""
    num = min(SHOWN_DIMENSIONS, fan.mean.shape[1])
    return [{name: rows[..., dimension].tolist() for name, rows in fan._asdict().items()} for dimension in range(num)]


def _changed(session: Session, given: Mapping[str, Any]) -> Any:
    """The session's settings with the given ones in their place."""
    for name, value in given.items():
        if not isinstance(value, str):
            raise UserError(f"{name} must be text, got {shown(value)}")
    planner = dict(session.settings.planner)
    for name in SEARCH:
        if name in given:
            planner.pop(name, None)
    texts = {name: given[name].strip() for name in SEARCH if given.get(name, "").strip()}
    planner |= read_values(_SEARCH_SETTINGS, texts)
    changes: dict[str, Any] = {name: given[name].strip() or None for name in TEXTS if name in given}
    if "mode" in changes and changes["mode"] not in MODES:
        raise_unknown("mode", str(changes["mode"]), MODES)
    return replace(session.settings, planner=planner, **changes)


def _read_object(text: str) -> dict[str, Any]:
    try:
        request = json.loads(text)
    except (ValueError, RecursionError):
        request = None
    if not isinstance(request, dict):
        raise UserError("a request must be a JSON object")
    return request


def _read_picture(session: Session, value: Any) -> bytes:
    if value == "camera":
        return encode_png(session.present_frame())
    try:
        return base64.b64decode(value, validate=True)
    except (TypeError, ValueError, binascii.Error):
        raise UserError("a picture must be a PNG file in base64") from None


def _read_number(name: str, value: Any) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    try:
        number = float(value) if is_number else math.nan
    except OverflowError:  # a whole number beyond the largest float
        number = math.inf
    if not math.isfinite(number):
        raise UserError(f"{name} must be a finite number, got {shown(value)}")
    return number


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: _plain(inner) for name, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, list | tuple) else value
