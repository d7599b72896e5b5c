"""Planning models of simulators: MuJoCo models, and step functions written in jax.

MuJoCo and jax are imported when a model is made, so that `latentplan.planning` needs neither.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from einops import rearrange
from torch import Tensor
from torch.utils._pytree import TreeSpec, tree_flatten, tree_leaves, tree_structure, tree_unflatten

from latentplan.config.extras import import_extra
from latentplan.planning.model import State, check_shape, check_tensor

if TYPE_CHECKING:
    import mujoco

LARGEST = 1e10  # MuJoCo's mjMAXVAL: a state with a larger number is unstable


@dataclass(frozen=True)
class Physics:
    """Named parts of MuJoCo states, float64.

    Attributes:
        time: Simulated seconds, (rows,).
        qpos: Positions, (rows, nq).
        qvel: Velocities, (rows, nv).
        act: Activations of the actuators, (rows, na).
        sensors: Readings by sensor name, (rows, size); empty for the last state of a plan.
    """

    time: Tensor
    qpos: Tensor
    qvel: Tensor
    act: Tensor
    sensors: Mapping[str, Tensor]


class MuJoCoModel:
    """A MuJoCo model as a planning model; `mujoco.rollout` simulates all candidates in threads.

    A state is a row of MuJoCo's full physics state; `state(data)` makes one. Bodies that are moved by hand (mocap) and
    applied forces keep the values that the model starts with. A simulation that becomes unstable gets the reward NaN
    from then on, so that its candidate is never chosen; MuJoCo's warnings of it are not printed, since a search may
    have hundreds of such candidates. The model passes no gradients.

    Args:
        mjmodel: The model, or the one of a `dm_control` physics (`physics.model`); it is copied.
        cost: `cost(physics, action) -> (rows,)`, minimised, of the state before each step and the action (rows,
            action) of the step. The sensors are those of that state under that action.
        terminal_cost: `terminal_cost(physics) -> (rows,)`, of the last state of a plan; None adds nothing.
        substeps: Simulator steps per model step; the action is held during all of them.
        threads: Number of threads; None takes torch's number.

    Attributes:
        action_dim: Number of actuators.
        action_low: Lowest control of each actuator, (action,); -1 without a limit.
        action_high: Highest control of each actuator, (action,); 1 without a limit.

    Raises:
        UserError: MuJoCo is not installed.
    """

    def __init__(
        self,
        mjmodel: mujoco.MjModel,
        cost: Callable[[Physics, Tensor], Tensor],
        terminal_cost: Callable[[Physics], Tensor] | None = None,
        *,
        substeps: int = 1,
        threads: int | None = None,
    ) -> None:
        library = import_extra("mujoco", "MuJoCoModel")
        if substeps < 1:
            raise ValueError(f"substeps must be at least 1, got {substeps}")
        mjmodel = _unwrap(mjmodel)
        if mjmodel.nu == 0:
            raise ValueError("the MuJoCo model has no actuator, so there is no action to plan")
        self.mjmodel = mjmodel.__copy__()
        # Without a reset an unstable simulation stops, which `_advance` notices.
        self.mjmodel.opt.disableflags |= library.mjtDisableBit.mjDSBL_AUTORESET
        self.cost, self.terminal_cost = cost, terminal_cost
        self.substeps, self.threads = substeps, threads or torch.get_num_threads()
        self.action_dim = int(mjmodel.nu)
        limits = torch.from_numpy(mjmodel.actuator_ctrlrange.copy())
        is_limited = torch.from_numpy(mjmodel.actuator_ctrllimited.astype(bool))[:, None]
        bounds = torch.where(is_limited, limits, limits.new_tensor([-1.0, 1.0]))
        self.action_low, self.action_high = bounds.unbind(dim=1)
        if terminal_cost is not None:  # a planner detects an optional method by the attribute
            self.value = self._value

    def state(self, data: mujoco.MjData) -> Tensor:
        """Returns the physics state of MuJoCo data as one row, float64 (1, size).

        Args:
            data: The data, or those of a `dm_control` physics (`physics.data`).
        """
        import mujoco

        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        row = torch.empty(1, mujoco.mj_stateSize(self.mjmodel, kind), dtype=torch.float64, device="cpu")
        mujoco.mj_getState(self.mjmodel, _unwrap(data), row[0].numpy(), kind)
        return row

    def physics(self, state: Tensor) -> Physics:
        """Returns the named parts of states (rows, size), without sensors."""
        return self._physics(state.double(), {})

    def step(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the state after one model step, (rows, size), and minus the cost of the step, (rows,)."""
        rewards, following = self.rollout(state, action[:, None])
        return following, rewards[:, 0]

    def rollout(self, state: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Returns minus the costs of all steps, (rows, horizon), and the last states, (rows, size).

        Args:
            state: Start of every rollout, (rows, size).
            actions: Controls, (rows, horizon, action).
        """
        start, controls = state.detach().cpu().double(), actions.detach().cpu().double()
        before, sensordata, last, is_stable = self._advance(start, controls)
        rows = self._physics(rearrange(before, "row step ... -> (row step) ..."), self._by_name(sensordata))
        costs = self.cost(rows, rearrange(controls, "row step action -> (row step) action"))
        check_tensor("cost", costs, rows.time.shape)
        if costs.shape != rows.time.shape:
            raise ValueError(f"cost must return shape {tuple(rows.time.shape)}, got {tuple(costs.shape)}")
        rewards = -rearrange(costs, "(row step) -> row step", row=len(start)).masked_fill(~is_stable, float("nan"))
        return rewards.to(state), last.to(state)

    def _value(self, state: Tensor) -> Tensor:
        """Returns minus the terminal cost of states, (rows,)."""
        assert self.terminal_cost is not None
        cost = self.terminal_cost(self.physics(state.cpu()))
        check_shape("terminal_cost", cost, state.shape[:1])
        return -cost.to(state)

    def _advance(self, start: Tensor, controls: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Simulates the controls (rows, horizon, action).

        Returns:
            The states before each step, (rows, horizon, size); their sensor readings, (rows, horizon, reading); the
            last states, (rows, size); and whether each step is stable, (rows, horizon).
        """
        pool, data = self._workers
        substeps = controls.repeat_interleave(self.substeps, dim=1).contiguous()
        with _muted_warnings():
            states, sensordata = pool.rollout(self.mjmodel, data, start.contiguous().numpy(), substeps.numpy())
        after = torch.from_numpy(states)[:, self.substeps - 1 :: self.substeps]
        before = torch.cat([start[:, None], after[:, :-1]], dim=1)
        # The time of an unstable simulation stops.
        duration = self.mjmodel.opt.timestep * self.substeps
        expected = start[:, :1] + duration * torch.arange(1, controls.shape[1] + 1, device="cpu")
        is_stable = (after[:, :, 0] - expected).abs() < self.mjmodel.opt.timestep / 2
        is_stable &= before.abs().amax(dim=2) < LARGEST  # false for NaN too
        return before, torch.from_numpy(sensordata)[:, :: self.substeps], after[:, -1], is_stable

    def _physics(self, states: Tensor, sensors: Mapping[str, Tensor]) -> Physics:
        model = self.mjmodel
        rest = states.shape[1] - 1 - model.nq - model.nv - model.na  # histories and plugins
        time, qpos, qvel, act, _ = states.split([1, model.nq, model.nv, model.na, rest], dim=1)
        return Physics(time[:, 0], qpos, qvel, act, sensors)

    def _by_name(self, sensordata: Tensor) -> dict[str, Tensor]:
        flat, model = rearrange(sensordata, "row step reading -> (row step) reading"), self.mjmodel
        ends = zip(range(model.nsensor), model.sensor_adr, model.sensor_dim, strict=True)
        return {model.sensor(index).name: flat[:, start : start + size] for index, start, size in ends}

    @cached_property
    def _local(self) -> threading.local:
        return threading.local()

    @property
    def _workers(self) -> tuple[Any, list[Any]]:
        """The pool of this Python thread and the data of its threads; two threads may plan in one model."""
        import mujoco.rollout

        if not hasattr(self._local, "workers"):
            threads = self.threads if self.threads > 1 else 0
            data = [mujoco.MjData(self.mjmodel) for _ in range(max(threads, 1))]
            self._local.workers = (mujoco.rollout.Rollout(nthread=threads), data)
        workers: tuple[Any, list[Any]] = self._local.workers
        return workers

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_local"}


class _Mute:
    """Discards MuJoCo's warnings, whose handler belongs to the whole process, while any thread simulates candidates."""

    def __init__(self) -> None:
        self._lock, self._num_threads, self._handler = threading.Lock(), 0, None

    @contextmanager
    def __call__(self) -> Iterator[None]:
        import mujoco

        with self._lock:
            if self._num_threads == 0:
                self._handler = mujoco.get_mju_user_warning()
                mujoco.set_mju_user_warning(lambda text: None)
            self._num_threads += 1
        try:
            yield
        finally:
            with self._lock:
                self._num_threads -= 1
                if self._num_threads == 0:
                    mujoco.set_mju_user_warning(self._handler)


_muted_warnings = _Mute()


def _unwrap(part: Any) -> Any:
    """The model or the data of MuJoCo that dm_control wraps."""
    return getattr(part, "ptr", part)


class JaxModel:
    """A model whose functions are written in jax for one state; tensors are shared with torch through DLPack.

    `jax.vmap` makes the functions work on rows, `jax.jit` compiles them, and `jax.lax.scan` makes one program of a
    whole plan; the first search of each size waits for the compiler. Gradients pass through to torch. States in float64
    need `jax.config.update("jax_enable_x64", True)`.

    Args:
        step: `step(state, action) -> (next_state, reward)` for one state, an array or a tuple, NamedTuple, dictionary
            or list of arrays; `reward` is a scalar.
        value: `value(state) -> scalar`, the expected return from the last state of a plan on; None: no value.

    Raises:
        UserError: jax is not installed.
    """

    def __init__(
        self,
        step: Callable[[Any, Any], tuple[Any, Any]],
        value: Callable[[Any], Any] | None = None,
    ) -> None:
        import_extra("jax", "JaxModel")
        self._step_one, self._value_one = step, value
        if value is not None:  # a planner detects an optional method by the attribute
            self.value = self._value

    def step(self, state: State, action: Tensor) -> tuple[State, Tensor]:
        """Returns the next state, rows (rows,), and the reward of the step, (rows,)."""
        following, reward = self._call("step", (state, action), like=(state, action))
        return following, reward

    def rollout(self, state: State, actions: Tensor) -> tuple[Tensor, State]:
        """Returns the rewards along actions (rows, horizon, action), (rows, horizon), and the last state."""
        last, rewards = self._call("rollout", (state, actions), like=(state, actions))
        return rewards, last

    def _value(self, state: State) -> Tensor:
        value: Tensor = self._call("value", (state,), like=tree_leaves(state)[0])
        return value

    def _call(self, name: str, arguments: tuple[Any, ...], like: Any) -> Any:
        """Returns the result of a compiled function, with the structure of `like`."""
        leaves, structure = tree_flatten(arguments)
        wanted = tree_structure(like)
        if torch.is_grad_enabled() and any(leaf.requires_grad for leaf in leaves):
            return tree_unflatten(_JaxCall.apply(self._compiled, name, structure, wanted, *leaves), wanted)
        return tree_unflatten(_evaluate(self._compiled[name], structure, wanted, leaves), wanted)

    @cached_property
    def _compiled(self) -> dict[str, Callable[..., Any]]:
        """The compiled functions of rows, and under `name gradient` what maps a gradient of results to arguments."""
        import jax

        def rollout(state: Any, actions: Any) -> tuple[Any, Any]:
            return jax.lax.scan(self._step_one, state, actions)  # type: ignore[no-any-return]

        compiled = {}
        for name, function in {"step": self._step_one, "rollout": rollout, "value": self._value_one}.items():
            if function is not None:
                rows = jax.vmap(function)
                compiled[name] = jax.jit(rows)
                compiled[f"{name} gradient"] = jax.jit(
                    lambda arguments, gradient, rows=rows: jax.vjp(rows, *arguments)[1](gradient)
                )
        return compiled

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_compiled"}


class _JaxCall(torch.autograd.Function):
    """A compiled function of a `JaxModel` with its gradient."""

    @staticmethod
    def forward(
        ctx: Any,
        compiled: Mapping[str, Callable[..., Any]],
        name: str,
        structure: TreeSpec,
        wanted: TreeSpec,
        *leaves: Tensor,
    ) -> tuple[Tensor, ...]:
        ctx.gradient, ctx.structure, ctx.wanted = compiled[f"{name} gradient"], structure, wanted
        ctx.save_for_backward(*leaves)
        return tuple(_evaluate(compiled[name], structure, wanted, leaves))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        arguments = _to_jax(ctx.saved_tensors, ctx.structure)
        found = ctx.gradient(arguments, _to_jax(gradients, ctx.wanted))
        leaves = zip(ctx.structure.flatten_up_to(found), ctx.saved_tensors, strict=True)
        # An integer, such as a counter of steps, has no gradient in torch, and one without numbers (float0) in jax.
        known = [torch.from_dlpack(leaf) if tensor.is_floating_point() else None for leaf, tensor in leaves]
        return None, None, None, None, *known


def _evaluate(
    function: Callable[..., Any], structure: TreeSpec, wanted: TreeSpec, leaves: Sequence[Tensor]
) -> list[Tensor]:
    """Returns the leaves of a compiled function's result, for the leaves of its arguments."""
    return _to_torch(function(*_to_jax(leaves, structure)), wanted)


def _to_jax(leaves: Sequence[Tensor], structure: TreeSpec) -> Any:
    """Returns the pytree of these leaves with jax arrays, which share the memory of contiguous tensors."""
    import jax

    def convert(leaf: Tensor) -> Any:
        array = jax.dlpack.from_dlpack(leaf.detach().contiguous())
        if array.dtype.itemsize != leaf.element_size():
            raise TypeError(f'{leaf.dtype} needs jax.config.update("jax_enable_x64", True); else use 32 bits')
        return array

    return tree_unflatten([convert(leaf) for leaf in leaves], structure)


def _to_torch(tree: Any, structure: TreeSpec) -> list[Tensor]:
    """Returns the leaves of a pytree of jax arrays as tensors, in the order of keys of a structure."""
    import jax

    jax.block_until_ready(tree)
    return [torch.from_dlpack(leaf) for leaf in structure.flatten_up_to(tree)]
