"""Plan beside a ROS 2 timer: the callback takes its action from the newest plan, and a second thread searches.

With ROS 2 (`rclpy`) a node reads the position of a robot from the topic `position` and writes its velocity to the topic
`velocity`. Without ROS 2 the same callback drives a simulated robot. Prints the distance to the goal at the end.
"""

import time
from importlib.util import find_spec

import torch

from latentplan.planning import BackgroundPlanner, CEMPlanner, FunctionModel, PlanScheduler

PERIOD, GOAL = 0.02, torch.tensor([[1.0, -0.5]])  # seconds, metres
MODEL = FunctionModel(lambda state, action: state + PERIOD * action, lambda state, action: -(state - GOAL).norm(dim=1))
PLANNER = CEMPlanner(action_dim=2, horizon=20, num_samples=64)


class Pilot:
    """The state of a node: the scheduler, and the newest position (x, y) of the robot in m."""

    def __init__(self, scheduler: PlanScheduler) -> None:
        self.scheduler, self.position = scheduler, (0.0, 0.0)

    def on_timer(self) -> list[float]:
        """The velocity (x, y) of this period in m/s; the answer comes at once, and the search goes on in its thread."""
        action: list[float] = self.scheduler.decide(torch.tensor([self.position])).action[0].tolist()
        return action


def run_ros(pilot: Pilot) -> None:
    """Drives the robot behind the ROS 2 topics for 10 s."""
    import rclpy
    from geometry_msgs.msg import Point, Vector3

    rclpy.init()
    node = rclpy.create_node("pilot")
    publisher = node.create_publisher(Vector3, "velocity", 1)
    node.create_subscription(Point, "position", lambda at: setattr(pilot, "position", (at.x, at.y)), 1)
    node.create_timer(PERIOD, lambda: publisher.publish(Vector3(**dict(zip("xy", pilot.on_timer(), strict=True)))))
    end = time.monotonic() + 10.0
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=PERIOD)


def run_simulated(pilot: Pilot) -> None:
    """Drives a simulated robot for 150 periods."""
    for _ in range(150):
        velocity = pilot.on_timer()
        x, y = (place + PERIOD * speed for place, speed in zip(pilot.position, velocity, strict=True))
        pilot.position = (x, y)
        time.sleep(PERIOD)


if __name__ == "__main__":
    torch.set_num_threads(1)  # the search uses the other core
    with BackgroundPlanner(PLANNER, MODEL, worker="thread") as background:  # lambdas cannot be sent to a process
        pilot = Pilot(PlanScheduler(PLANNER, MODEL, background))
        (run_ros if find_spec("rclpy") else run_simulated)(pilot)
        print(f"at the end: distance {(torch.tensor([pilot.position]) - GOAL).norm():.2f} m")
