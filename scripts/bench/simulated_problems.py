"""Control problems whose dynamics are a simulator or a trained agent's model; see `bench.problems` for the interface.

- `push`: a ball pushes a box to a goal, in MuJoCo; nothing moves the box but contact.
- `humanoid`: a body with 40 hinges reaches with hands and feet, in MuJoCo.
- `latent`: the walker that ships walks in its own latent space.

States are rows of numbers in float32, so that planners of other libraries can take them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import torch
from torch import Tensor

from bench.problems import ControlProblem
from latentplan.agents.checkpoint import load_model
from latentplan.models import State
from latentplan.planning import Model, MuJoCoModel, Physics

CHECKPOINT = Path(__file__).resolve().parents[2] / "checkpoints" / "walker-walk"


@dataclass(frozen=True)
class SimulatedProblem(ControlProblem):
    """A problem whose model computes the next state and the cost together.

    Attributes:
        simulator: The model of the true dynamics; its reward is the negative cost.
    """

    simulator: Any = None

    def model(self) -> Any:
        """Returns the true dynamics as a model whose reward is the negative cost."""
        return self.simulator


def push() -> SimulatedProblem:
    """Returns the problem of pushing a box to a goal with a ball.

    A ball of radius 0.05 is pushed by two forces on a plane, where a square box of width 0.2 slides and turns with
    friction. A step takes 0.04 s. The cost of a step is the distance of the box to the goal at (0.4, -0.1), plus 0.2
    times the distance of ball and box, plus 0.001 |force|². A run starts with the box at the origin and the ball at
    (-0.05, 0.2), up to 0.03 off in each direction.
    """
    goal = torch.tensor([0.4, -0.1], dtype=torch.float64)

    def cost(physics: Physics, action: Tensor) -> Tensor:
        ball, box = physics.qpos[:, :2], physics.qpos[:, 2:4]
        return (box - goal).norm(dim=1) + 0.2 * (ball - box).norm(dim=1) + 0.001 * action.square().sum(dim=1)

    def draw_start(generator: torch.Generator) -> Tensor:
        ball = torch.tensor([-0.05, 0.2]) + 0.03 * (2 * torch.rand(2, generator=generator) - 1)
        return torch.cat([torch.zeros(1), ball, torch.zeros(8)])  # time, ball, box (x, y, angle), velocities

    return _from_mujoco(
        "push", mujoco.MjModel.from_xml_string(PUSH), cost, draw_start, substeps=2, horizon=20, num_steps=50
    )


PUSH = """
<mujoco>
  <option timestep="0.02" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="ball">
      <joint name="ball_x" type="slide" axis="1 0 0" damping="2"/>
      <joint name="ball_y" type="slide" axis="0 1 0" damping="2"/>
      <geom type="sphere" size=".05" mass=".3"/>
    </body>
    <body name="box">
      <joint type="slide" axis="1 0 0" frictionloss=".3" damping=".5"/>
      <joint type="slide" axis="0 1 0" frictionloss=".3" damping=".5"/>
      <joint type="hinge" axis="0 0 1" frictionloss=".02" damping=".01"/>
      <geom type="box" size=".1 .1 .05" mass=".3"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="ball_x" gear="3" ctrlrange="-1 1" ctrllimited="true"/>
    <motor joint="ball_y" gear="3" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator>
</mujoco>
"""


def humanoid() -> SimulatedProblem:
    """Returns the problem of reaching with a body of humanoid size: 40 hinges, each with a motor.

    The pelvis is fixed. A spine of three bodies with three hinges each carries a head (3) and two arms (shoulder 3,
    elbow 1, wrist 2, hand 1); each leg has a hip (3), a knee (1), an ankle (2) and toes (1). A step takes 0.03 s, under
    gravity. The cost of a step is the squared distance of the hands to points above the head and of the feet to points
    in front of the body, plus 0.01 |velocity|² / 40 and 0.01 |action|² / 40. A run starts hanging at rest, each hinge
    up to 0.1 rad off.
    """
    targets = {
        "left_hand": (0.3, 0.3, 0.9),
        "right_hand": (0.3, -0.3, 0.9),
        "left_toes": (0.6, 0.15, -0.4),
        "right_toes": (0.6, -0.15, -0.4),
    }
    points = {name: torch.tensor(point, dtype=torch.float64) for name, point in targets.items()}

    def cost(physics: Physics, action: Tensor) -> Tensor:
        distances = [(physics.sensors[name] - point).square().sum(dim=1) for name, point in points.items()]
        effort = 0.01 * (physics.qvel.square() + action.square()).mean(dim=1)
        return torch.stack(distances).sum(dim=0) + effort

    def draw_start(generator: torch.Generator) -> Tensor:
        pose = 0.1 * (2 * torch.rand(40, generator=generator) - 1)
        return torch.cat([torch.zeros(1), pose, torch.zeros(40)])  # time, angles, velocities

    body = _build_humanoid(points)
    return _from_mujoco("humanoid", body, cost, draw_start, substeps=1, horizon=8, num_steps=15)


def latent() -> SimulatedProblem:
    """Returns the problem of walking in the latent space of the agent `walker-walk`, without its actor and value.

    State: the recurrent state and the latent, side by side. A step is a decision of the agent. The cost of a step is 2,
    the highest reward of a decision, minus the predicted reward. A run starts where ten random actions lead from the
    state without memory.
    """
    model, config, _ = load_model(CHECKPOINT)
    model.requires_grad_(False)
    sizes = [model.config.deter_dim, model.config.latent_dim]
    highest = float(config.env.action_repeat)

    class FlatModel:
        def step(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
            following, reward = model.step(State(*state.split(sizes, dim=1)), action)
            return torch.cat(following, dim=1), reward - highest

        def rollout(self, state: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
            rewards, last = model.rollout(State(*state.split(sizes, dim=1)), actions)
            return rewards - highest, torch.cat(last, dim=1)

    @torch.no_grad()
    def draw_start(generator: torch.Generator) -> Tensor:
        state = torch.zeros(1, sum(sizes))
        for _ in range(10):
            action = 2 * torch.rand(1, model.action_dim, generator=generator) - 1
            state, _ = simulator.step(state, action)
        return state[0]

    simulator = FlatModel()
    return _problem("latent", simulator, model.action_dim, draw_start, horizon=10, num_steps=30)


def _from_mujoco(
    name: str,
    mjmodel: mujoco.MjModel,
    cost: Callable[[Physics, Tensor], Tensor],
    draw_start: Callable[[torch.Generator], Tensor],
    **sizes: Any,
) -> SimulatedProblem:
    simulator = MuJoCoModel(mjmodel, cost, substeps=sizes.pop("substeps"))
    return _problem(name, simulator, simulator.action_dim, draw_start, **sizes)


def _problem(
    name: str, simulator: Model, action_dim: int, draw_start: Callable[[torch.Generator], Tensor], **sizes: Any
) -> SimulatedProblem:
    """Returns the problem of a model, for actions in [-1, 1]."""

    def dynamics(state: Tensor, action: Tensor) -> Tensor:
        return simulator.step(state, action)[0]

    def cost(state: Tensor, action: Tensor) -> Tensor:
        return -simulator.step(state, action)[1]

    return SimulatedProblem(
        name,
        action_dim,
        -1.0,
        1.0,
        dynamics=dynamics,
        cost=cost,
        draw_start=draw_start,
        simulator=simulator,
        **sizes,
    )


def _build_humanoid(sites: Iterable[str]) -> mujoco.MjModel:
    """Returns the body of `humanoid`, with a sensor for the position of each site."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = 0.03, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    arm = [("shoulder", "xyz", 0.28), ("elbow", "y", 0.25), ("wrist", "xz", 0.08), ("hand", "y", 0.1)]
    leg = [("hip", "xyz", 0.4), ("knee", "y", 0.4), ("ankle", "xy", 0.1), ("toes", "y", 0.1)]
    spine = [("waist", "xyz", 0.15), ("back", "xyz", 0.15), ("chest", "xyz", 0.15)]
    chest = _add_limb(spec, spec.worldbody, "", spine, (0.0, 0.0, 0.0), up=True)
    _add_limb(spec, chest, "", [("head", "xyz", 0.2)], (0.0, 0.0, 0.15), up=True)
    for side, sign in (("left_", 1.0), ("right_", -1.0)):
        _add_limb(spec, chest, side, arm, (0.0, 0.2 * sign, 0.15), up=False)
        _add_limb(spec, spec.worldbody, side, leg, (0.0, 0.1 * sign, 0.0), up=False)
    for site in sites:
        kinds = {"type": mujoco.mjtSensor.mjSENS_FRAMEPOS, "objtype": mujoco.mjtObj.mjOBJ_SITE}
        spec.add_sensor(name=site, objname=site, **kinds)
    return spec.compile()


def _add_limb(
    spec: Any, body: Any, prefix: str, parts: Sequence[tuple[str, str, float]], start: Sequence[float], *, up: bool
) -> Any:
    """Adds a chain of bodies with a motor at each hinge, and returns the last body.

    Args:
        spec: The model.
        body: The body that carries the chain.
        prefix: Begins all names.
        parts: Of each body: its name, the axes of its hinges, and its length in m.
        start: Place of the first body on the carrying one.
        up: Whether the chain points up, else down.
    """
    for part, axes, length in parts:
        tip = [0.0, 0.0, length if up else -length]
        body = body.add_body(name=prefix + part, pos=start)
        for axis in axes:
            joint = body.add_joint(name=f"{prefix}{part}_{axis}", axis=[float(axis == other) for other in "xyz"])
            joint.type, joint.range, joint.limited = mujoco.mjtJoint.mjJNT_HINGE, [-2.0, 2.0], True
            joint.damping[0], joint.armature = 2.0, 0.03
            motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.ctrlrange, motor.ctrllimited = [-1.0, 1.0], True
            motor.gear[0] = 60.0 if part in ("hip", "waist", "back", "chest") else 30.0
        shape = {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "fromto": [0.0, 0.0, 0.0, *tip], "size": [0.04, 0.0, 0.0]}
        body.add_geom(density=200.0, contype=0, conaffinity=0, **shape)
        body.add_site(name=prefix + part, pos=tip)
        start = tip
    return body


SIMULATED = {"push": push, "humanoid": humanoid, "latent": latent}
"""By name, the function that makes a problem; the models of some take a second to load."""
