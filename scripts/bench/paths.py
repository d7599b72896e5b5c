"""`benchmark.py paths`: milliseconds of each fast path of the world model beside its reference."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from bench.options import ComposeRequest
from bench.report import format_number, format_table, write_json
from latentplan.commands.flags import overrides
from latentplan.config import LearningConfig, ModelConfig, UserError
from latentplan.config.checks import at_least
from latentplan.config.parsing import option

if TYPE_CHECKING:
    import torch

    from latentplan.models import WorldModel
    from latentplan.models.backend import Backend

WARM_UP_CALLS = 2
Call = Callable[["WorldModel"], Any]


@dataclass(frozen=True, kw_only=True)
class Request(ComposeRequest):
    """Flags of `benchmark.py paths`.

    Attributes:
        samples: Candidates of the rollouts.
        horizon: Model steps of each candidate.
        repeats: Timed calls of each path.
        json: Result as JSON.
        model: Settings of the model.
        learning: Settings of the learning.
    """

    samples: tuple[int, ...] = option((128, 512), separator=",")
    horizon: int = 8
    repeats: int = 20
    json: Path | None = option(None, metavar="FILE", is_output=True)
    model: dict[str, Any] = overrides(ModelConfig, prefix="model.")
    learning: dict[str, Any] = overrides(LearningConfig, prefix="learning.")

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, horizon=1, repeats=1)
        if min(self.samples) < 1:
            raise UserError(f"--samples must be at least 1, got {min(self.samples)}")


def run(request: Request) -> int:
    """Times every fast path of the device and its reference, in turns, and prints the medians."""
    samples, horizon, repeats = list(request.samples), request.horizon, request.repeats
    config = request.compose({"model": request.model, "learning": request.learning})
    device_name = request.use_device()
    action_dim = request.action_size(config)
    import torch

    device = torch.device(device_name)
    from bench.machine import describe_machine
    from latentplan.models import WorldModel

    torch.manual_seed(0)
    model = WorldModel(config.model, action_dim).to(device)
    results: list[dict[str, Any]] = []
    for name, call, reference, fast, context in _paths(model, config.learning, samples, horizon, device):
        reference_ms, fast_ms = _milliseconds(model, call, reference, fast, context, repeats, device)
        results.append({"path": name, "reference_ms": reference_ms, "fast_ms": fast_ms})
    rows = [
        [
            row["path"],
            format_number(row["reference_ms"], 3),
            format_number(row["fast_ms"], 3),
            format_number(_ratio(row), 2),
        ]
        for row in results
    ]
    machine = describe_machine(device)
    print(f"{config.env.domain} on {machine['name']} ({device.type}, {machine['threads']} threads), horizon {horizon}")
    print(format_table(["path", "reference ms", "fast ms", "ratio"], rows))
    about = {"domain": config.env.domain, "horizon": horizon, "repeats": repeats, "machine": machine}
    write_json(request.json, {**about, "paths": [{**row, "ratio": _ratio(row)} for row in results]})
    return 0


def _ratio(row: dict[str, Any]) -> float:
    return float(row["reference_ms"] / row["fast_ms"])


def _milliseconds(
    model: WorldModel,
    call: Call,
    reference: Backend,
    fast: Backend,
    context: Callable[[], AbstractContextManager[Any]],
    repeats: int,
    device: torch.device,
) -> tuple[float, float]:
    """Median milliseconds of the reference and of the fast path; the two are called in turns."""
    from bench.machine import read_clock

    seconds: tuple[list[float], list[float]] = ([], [])
    for repeat in range(WARM_UP_CALLS + repeats):
        for backend, times, inside in ((reference, seconds[0], nullcontext), (fast, seconds[1], context)):
            model.backend = backend
            with inside():
                started = read_clock(device)
                call(model)
                ended = read_clock(device)
            if repeat >= WARM_UP_CALLS:
                times.append(ended - started)
    return 1000.0 * median(seconds[0]), 1000.0 * median(seconds[1])


def _paths(
    model: WorldModel, learning: Any, samples: list[int], horizon: int, device: torch.device
) -> Iterator[tuple[str, Call, Backend, Backend, Callable[[], AbstractContextManager[Any]]]]:
    """Name, call, reference backend, fast backend and context of each fast path of the device."""
    import torch

    from bench.path_calls import augmentation_calls, frame_calls, learner_calls, planner_calls
    from latentplan.models.backend import Backend
    from latentplan.models.fast import accelerate
    from latentplan.models.fast.native_frame import NativeFrameFunctions

    precision = accelerate(model).trunk_dtype
    kinds: dict[str, Callable[[], AbstractContextManager[Any]]] = {"converted weights": nullcontext}
    if device.type == "cpu":
        kinds = {
            "compiled call": nullcontext,
            "compiled kernels": _without_compiled,
            "converted weights": _without_kernels,
        }
        with torch.no_grad():
            if model.backend._packed(model) is None:  # type: ignore[attr-defined]
                del kinds["compiled call"]
    backend = type(model.backend)
    for rows in samples:
        for name, call in planner_calls(model, rows, horizon).items():
            for kind, context in kinds.items():
                if kind == "compiled call" or name.startswith(("rollout", "proposals")):
                    yield f"{name}, {kind}", call, Backend(precision), backend(), context
    for name, call in frame_calls(model).items():
        yield name, call, Backend(precision), backend(), nullcontext
        if NativeFrameFunctions.can_pack(model):
            yield f"{name}, converted weights", call, Backend(precision), backend(), _without_compiled_frames
    for name, call in augmentation_calls(model, learning).items() if device.type == "cpu" else ():
        yield name, call, Backend(precision), backend(), nullcontext
    for name, call in learner_calls(model, learning).items():
        yield name, call, Backend(precision), backend(), nullcontext


def _without_compiled() -> AbstractContextManager[Any]:
    from latentplan.models.fast import compiled

    return patch.object(compiled, "pack", lambda *_: None)


def _without_compiled_frames() -> AbstractContextManager[Any]:
    from latentplan.models.fast.native_frame import NativeFrameFunctions

    return patch.object(NativeFrameFunctions, "can_pack", lambda _: False)


def _without_kernels() -> AbstractContextManager[Any]:
    from latentplan.models.fast import library

    stack = ExitStack()
    stack.enter_context(_without_compiled())
    stack.enter_context(patch.object(library, "load", lambda **_: None))
    return stack
