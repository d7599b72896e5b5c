"""Export of the actor as a program: a file that runs with torch alone, without this package.

One call is one decision. Inputs and outputs are plain tensors, also the belief:

    action, deter, stoch = program(frame, deter, stoch, action, is_first)

`frame` is uint8 (batch, 64, 64, 3), or of the shape that the agent's frames have. `deter`, float32 (batch, deter), and
`stoch`, float32 (batch, latent), are the belief that the last call returned; an agent with four quarter turns has the
beliefs of all turns side by side. `action`, float32 (batch, action) in [-1, 1], is the action executed after the last
call. `is_first`, bool (batch,), is true at the first frame of an episode, where `deter`, `stoch` and `action` are not
read and may be zeros. The batch may have any size, and the rows do not influence each other.
"""

from __future__ import annotations

import copy
import importlib.util
import io
import json
import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram
from torch.utils._pytree import tree_flatten, tree_unflatten

from latentplan.agents.base import ModelAgent
from latentplan.agents.checkpoint import load_model
from latentplan.config import UserError, output_file
from latentplan.config.writing import replaced_whole
from latentplan.models import Rssm, State, WorldModel
from latentplan.models.fast import one_frame
from latentplan.models.heads import MixedActor
from latentplan.models.symmetry import turned

FORMATS = ("pt2", "onnx")
SIZES = "actor.json"  # the part of a .pt2 file that holds the sizes of the inputs
INPUTS = ("frame", "deter", "stoch", "action", "is_first")
OUTPUTS = ("new_action", "new_deter", "new_stoch")  # ONNX needs names that differ from the inputs'
EXAMPLE_ROWS = 2  # with a batch of 1, torch.export would fix the batch size at 1


class _Decision(nn.Module):
    """One decision: belief update and actor, with a copy of their weights."""

    def __init__(self, model: WorldModel) -> None:
        super().__init__()
        weights, self._turns = one_frame.convert_weights(model), model.config.turns
        choices = copy.deepcopy(model.actor) if isinstance(model.actor, MixedActor) else None
        self._choices = None if choices is None else choices.cpu().float().requires_grad_(False)
        tensors, self._layout = tree_flatten(weights)
        self._names = [f"weight_{index}" for index in range(len(tensors))]
        for name, tensor in zip(self._names, tensors, strict=True):
            self.register_buffer(name, tensor.detach().cpu().float().clone())

    def forward(
        self, frame: Tensor, deter: Tensor, stoch: Tensor, action: Tensor, is_first: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        weights = tree_unflatten([getattr(self, name) for name in self._names], self._layout)
        turns, (rows, size) = self._turns, action.shape
        taken = action[:, None].expand(-1, turns, -1).reshape(rows * turns, size)
        last = State(*(part.reshape(rows * turns, part.shape[1] // turns) for part in (deter, stoch)))
        read = taken if self._choices is None else self._choices.code(taken)
        advanced = one_frame.advance(weights, last, read).reshape(rows, deter.shape[1])
        begun = torch.where(is_first[:, None], 0.0, advanced).reshape(last.deter.shape)
        state = one_frame.see(weights, begun, turned(frame, turns))
        modes, _ = one_frame.act(weights, state) if self._choices is None else self._choices(state.features)
        mean = modes.reshape(rows, turns, size).mean(1)
        executed = torch.where(is_first[:, None] | ~action.isfinite(), 0.0, action)
        mean = torch.where(mean.isfinite().all(1, keepdim=True), mean, executed)  # as `ModelAgent.act`
        deters, stochs = (part.reshape(rows, part.shape[1] * turns) for part in state)
        return mean, deters, stochs


def export_actor(agent_or_checkpoint: ModelAgent | str | Path, path: str | Path, format: str = "pt2") -> Path:
    """Writes the actor as a program without this package and without a state of its own.

    Args:
        agent_or_checkpoint: An agent with a model, or the folder of a checkpoint or run.
        path: The file to write; an existing file is replaced whole.
        format: `pt2` (`torch.export`) or `onnx`, which needs the packages onnx and onnxscript.

    Returns:
        The path.

    Raises:
        UserError: The checkpoint, the format or the path cannot be used.
    """
    if format not in FORMATS:
        raise UserError(f"format must be one of {', '.join(FORMATS)}, got {format!r}")
    missing = [name for name in ("onnx", "onnxscript") if format == "onnx" and importlib.util.find_spec(name) is None]
    if missing:
        raise UserError(f"format onnx needs {' and '.join(missing)}: pip install onnx onnxscript, or --format pt2")
    target = Path(path)
    other = next((name for name in FORMATS if name != format and target.suffix == f".{name}"), None)
    if other is not None:
        raise UserError(f"{target} would hold a program in format {format}: give --format {other} or another file name")
    target = output_file(target, "the program's path")
    if isinstance(agent_or_checkpoint, ModelAgent):
        model = agent_or_checkpoint.model
    elif isinstance(agent_or_checkpoint, str | os.PathLike):
        model, _, _ = load_model(agent_or_checkpoint)
    else:
        raise UserError(f"a trained agent or its folder is exported, got {type(agent_or_checkpoint).__name__}")
    if model.spaces.vector_dim:
        raise UserError(
            "only agents that see pictures alone can be exported, and this one was trained with env.vectors"
        )
    if type(model.dynamics) is not Rssm:
        raise UserError(
            f"only agents with dynamics of the class Rssm can be exported, got {type(model.dynamics).__name__}"
        )
    try:
        with replaced_whole(target) as part:
            _write_program(_trace_actor(model), model, part, format)
    except OSError as error:
        raise UserError(f"cannot write {target}: {error.strerror}") from None
    return target


def input_sizes(model: WorldModel) -> dict[str, int]:
    """Sizes of a program's vector inputs: `deter`, `stoch` and `action`."""
    turns = model.config.turns
    return {
        "deter": turns * model.config.deter_dim,
        "stoch": turns * model.config.latent_dim,
        "action": model.action_dim,
    }


def _trace_actor(model: WorldModel) -> ExportedProgram:
    decision = _Decision(model).eval()
    batch = Dim("batch", min=1)
    dynamic = {name: {0: batch} for name in INPUTS}
    with torch.no_grad():
        return torch.export.export(decision, _example_inputs(model), dynamic_shapes=dynamic)


def _example_inputs(model: WorldModel) -> tuple[Tensor, ...]:
    with torch.device("cpu"):
        vectors = [torch.zeros(EXAMPLE_ROWS, size, dtype=torch.float32) for size in input_sizes(model).values()]
        frame = torch.zeros(EXAMPLE_ROWS, *model.spaces.frame_shape, dtype=torch.uint8)
        return frame, *vectors, torch.ones(EXAMPLE_ROWS, dtype=torch.bool)


def _write_program(program: ExportedProgram, model: WorldModel, path: Path, format: str) -> None:
    if format == "pt2":
        buffer = io.BytesIO()  # torch would end the interpreter if it wrote to a full disk itself
        torch.export.save(program, buffer, extra_files={SIZES: json.dumps(input_sizes(model))})
        path.write_bytes(buffer.getvalue())
        return
    options: dict[str, Any] = {"dynamo": True, "external_data": False, "verbose": False}
    torch.onnx.export(program, (), str(path), input_names=INPUTS, output_names=OUTPUTS, **options)
