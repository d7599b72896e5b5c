"""Plan in equations that are written in jax (`pip install 'latentplan[jax]'`): a drone lands on a platform.

`step` is written for one state; `JaxModel` compiles it for all candidates and all steps of a plan.
Prints the distance from the platform and the speed at the end, with plans and when it hovers.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import torch
from torch import Tensor

from latentplan.planning import CEMPlanner, JaxModel, ModelPredictiveController

DT, STEPS, MASS, ARM, INERTIA = 0.05, 80, 1.0, 0.25, 0.1  # s, decisions, kg, m, kg m²
PLATFORM = (2.0, 1.0)  # x and height in m


class Drone(NamedTuple):
    """Position (x, height), angle from upright, velocity (x, height) and turning speed, in m, rad and s."""

    position: jnp.ndarray
    angle: jnp.ndarray
    velocity: jnp.ndarray
    turning: jnp.ndarray


def step(drone: Drone, action: jnp.ndarray) -> tuple[Drone, jnp.ndarray]:
    """The next state of one drone and minus the cost of its state; the action is the thrust of two rotors, (2,)."""
    thrust = 5.0 * (action + 1.0)  # 0 to 10 N each; the drone hovers at 0
    force = thrust.sum() * jnp.stack([jnp.sin(drone.angle), jnp.cos(drone.angle)])
    velocity = drone.velocity + DT * (force / MASS - jnp.array([0.0, 10.0]))
    turning = drone.turning + DT * ARM * (thrust[0] - thrust[1]) / INERTIA
    following = Drone(drone.position + DT * velocity, drone.angle + DT * turning, velocity, turning)
    cost = jnp.sum((drone.position - jnp.array(PLATFORM)) ** 2) + 0.2 * jnp.sum(drone.velocity**2)
    return following, -cost - 2.0 * drone.angle**2 - 0.1 * drone.turning**2


def play(model: JaxModel, act: Callable[[Drone], Tensor]) -> tuple[float, float]:
    """Distance from the platform and speed after an episode that starts 2.2 m away."""
    drone = Drone(torch.zeros(1, 2), torch.zeros(1), torch.zeros(1, 2), torch.zeros(1))  # one row
    for _ in range(STEPS):
        drone, _ = model.step(drone, act(drone))
    return float((drone.position - torch.tensor(PLATFORM)).norm()), float(drone.velocity.norm())


def main() -> None:
    """Plays with plans, and with the thrust that holds the drone where it is."""
    model = JaxModel(step)
    planner = CEMPlanner(action_dim=2, horizon=20, num_samples=200)
    controller = ModelPredictiveController(planner, model, generator=torch.Generator().manual_seed(0))
    for name, act in {"planned": controller.act, "hovering": lambda drone: torch.zeros(1, 2)}.items():
        print("{}: distance {:.2f} m, speed {:.2f} m/s".format(name, *play(model, act)))


if __name__ == "__main__":
    main()
