"""Plan in a MuJoCo model: an arm with two joints lifts its hand to a point and holds it there, against gravity.

Prints the distance of the hand from the point at the end, with plans and without torque, and draws both (`arm.png`).
"""

from collections.abc import Callable

import mujoco
import torch
from matplotlib.figure import Figure
from torch import Tensor

from latentplan.planning import CEMPlanner, ModelPredictiveController, MuJoCoModel, Physics

TARGET = torch.tensor([0.5, 0.0, 0.4], dtype=torch.float64)
ARM = """
<mujoco><option timestep="0.01" integrator="implicitfast"/>
  <worldbody><body>
    <joint name="shoulder" axis="0 1 0" damping="0.5"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".04"/>
    <body pos="0 0 -.5">
      <joint name="elbow" axis="0 1 0" damping="0.5"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03"/>
      <site name="hand" pos="0 0 -.4"/></body>
  </body></worldbody>
  <actuator><motor joint="shoulder" ctrlrange="-25 25"/><motor joint="elbow" ctrlrange="-10 10"/></actuator>
  <sensor><framepos name="hand" objtype="site" objname="hand"/></sensor></mujoco>"""


def cost(physics: Physics, action: Tensor) -> Tensor:
    """Cost of each row: the distance of the hand in m, and a little for speed (rad/s) and torque (N m)."""
    distance = (physics.sensors["hand"] - TARGET).norm(dim=1)
    return distance + 0.005 * physics.qvel.square().sum(dim=1) + 1e-5 * action.square().sum(dim=1)


def play(model: MuJoCoModel, act: Callable[[Tensor], Tensor]) -> list[float]:
    """Distance of the hand from the point at each step, from the hanging arm on."""
    data, distances = mujoco.MjData(model.mjmodel), []
    for _ in range(75):
        data.ctrl[:] = act(model.state(data))[0].numpy()
        mujoco.mj_step(model.mjmodel, data, model.substeps)
        distances.append(float((torch.from_numpy(data.sensor("hand").data) - TARGET).norm()))
    return distances


def main() -> None:
    """Plays with plans and without torque, prints both distances and draws them."""
    model = MuJoCoModel(mujoco.MjModel.from_xml_string(ARM), cost, substeps=2)
    planner = CEMPlanner(action_dim=2, action_low=model.action_low, action_high=model.action_high, horizon=15)
    controller = ModelPredictiveController(planner, model, generator=torch.Generator().manual_seed(0))
    axes = Figure(layout="constrained").subplots()
    for name, act in {"planned": controller.act, "no torque": lambda state: torch.zeros(1, 2)}.items():
        distances = play(model, act)
        print(f"{name}: distance at the end {distances[-1]:.3f} m")
        axes.plot([0.02 * step for step in range(len(distances))], distances, label=name)
    axes.set(xlabel="time (s)", ylabel="distance of the hand from its target (m)")
    axes.legend()
    axes.figure.savefig("arm.png")


if __name__ == "__main__":
    main()
