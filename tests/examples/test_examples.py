"""Every example runs, prints the expected numbers and draws its picture."""

import ast
import re
import runpy
from pathlib import Path

import cv2
import pytest

from latentplan.training import Result

PUBLIC = {
    "latentplan",
    "latentplan.config",
    "latentplan.envs",
    "latentplan.evaluation",
    "latentplan.planning",
    "latentplan.training",
}
NAMES = (
    *(
        "corridor_constraint",
        "discrete_actions",
        "follow_reference",
        "own_environment",
        "plan_in_jax",
        "plan_in_mujoco",
    ),
    *("plan_learned_mlp", "plan_your_dynamics", "ros2_timer", "trained_agent_new_goal", "two_cameras"),
)


@pytest.fixture
def run_example(root, run_python, tmp_path):
    """Runs an example in an empty folder; returns the numbers of each line "label: ..." that it prints."""

    def run(name, timeout=300):
        result = run_python(root / "examples" / f"{name}.py", cwd=tmp_path, timeout=timeout)
        assert result.returncode == 0, result.stderr
        labelled = re.findall(r"^([\w ]+): (.*)$", result.stdout, flags=re.MULTILINE)
        return {label: [float(text) for text in re.findall(r"-?\d+\.?\d*", line)] for label, line in labelled}

    return run


def assert_is_drawn(path):
    """The picture can be read, has at least 300 x 300 pixels, and is not blank."""
    picture = cv2.imread(str(path))
    assert picture.shape[0] >= 300 and picture.shape[1] >= 300
    assert picture.std() > 10.0


def test_planning_in_own_dynamics_swings_the_pendulum_up(run_example, tmp_path):
    numbers = run_example("plan_your_dynamics")
    (planned_cost, planned_height), (idle_cost, idle_height) = numbers["planned"], numbers["no torque"]
    assert planned_cost < 1.5 and planned_height > 0.95
    assert idle_cost == 4.0 and idle_height == -1.0
    assert_is_drawn(tmp_path / "own_dynamics.png")


@pytest.mark.slow
def test_planning_in_a_learned_network_beats_random_actions(run_example):
    numbers = run_example("plan_learned_mlp")
    assert numbers["random actions"][0] < -900.0
    assert numbers["plans"][0] > -250.0


def test_closed_corridor_sends_the_plan_around(run_example, tmp_path):
    numbers = run_example("corridor_constraint")
    (open_y, *open_end), (closed_y, *closed_end) = numbers["corridor open"], numbers["corridor closed"]
    assert abs(open_y) < 0.15
    assert 0.6 < closed_y < 0.9
    for depth, distance in (open_end, closed_end):
        assert depth == 0.0 and distance < 0.1
    assert_is_drawn(tmp_path / "corridor.png")


@pytest.mark.slow
def test_trained_agent_reaches_a_new_goal(run_example, tmp_path):
    numbers = run_example("trained_agent_new_goal")
    (task_cart, task_upright), (goal_cart, goal_upright) = numbers["trained task"], numbers["new goal"]
    assert abs(task_cart) < 0.3 and task_upright > 0.9
    assert abs(goal_cart - 0.8) < 0.15 and goal_upright < -0.9
    assert_is_drawn(tmp_path / "new_goal.png")


@pytest.mark.slow
def test_own_environment_is_learned_within_seconds(run_example, tmp_path):
    numbers = run_example("own_environment")
    assert numbers["planner"][0] > 14.0 > 12.0 > numbers["random"][0]
    (run,) = tmp_path.glob("dot-*")
    assert (run / "checkpoints" / "best").is_dir() and (run / "metrics.csv").is_file()


@pytest.mark.slow
def test_two_cameras_and_a_vector_are_learned_from(run_example):
    numbers = run_example("two_cameras")
    assert numbers["planner"][0] > numbers["random"][0] + 2.0


@pytest.mark.slow
def test_discrete_actions_are_learned_far_above_random(run_example):
    numbers = run_example("discrete_actions", timeout=1200)
    assert numbers["planner"][0] > 2.0 * numbers["random"][0]


@pytest.mark.parametrize("name", ["discrete_actions", "own_environment", "two_cameras"])
def test_training_that_is_stopped_ends_an_example_which_can_be_run_again(name, root, tmp_path):
    folders, main = [], runpy.run_path(str(root / "examples" / f"{name}.py"))["main"]

    def stop(config, make_env):
        folders.append(Path(config.run.run_dir))
        return Result(folders[-1], 143, {})

    main.__globals__["train"] = stop
    for _ in range(2):
        with pytest.raises(SystemExit) as end:
            main(str(tmp_path))
        assert end.value.code == 143
    assert folders[0] != folders[1] and {folder.parent for folder in folders} == {tmp_path}


def test_planning_in_mujoco_lifts_the_hand_to_its_target(run_example, tmp_path):
    numbers = run_example("plan_in_mujoco")
    assert numbers["planned"][0] < 0.05
    assert numbers["no torque"][0] > 1.0
    assert_is_drawn(tmp_path / "arm.png")


def test_planning_in_jax_lands_the_drone(run_example):
    pytest.importorskip("jax")
    numbers = run_example("plan_in_jax")
    (distance, speed), (hovering, _) = numbers["planned"], numbers["hovering"]
    assert distance < 0.3 and speed < 0.5
    assert hovering > 2.0


def test_plan_that_knows_the_reference_follows_it_more_closely(run_example, tmp_path):
    numbers = run_example("follow_reference")
    assert numbers["future known"][0] < 0.1 < 0.3 < numbers["future unknown"][0]
    assert_is_drawn(tmp_path / "reference.png")


def test_timer_callback_drives_the_robot_to_its_goal_without_ros(run_example):
    assert run_example("ros2_timer")["at the end"][0] < 0.2


def test_every_example_is_run_here(root):
    assert {path.stem for path in (root / "examples").glob("*.py")} == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_example_is_short_and_uses_the_public_interface(name, root):
    source = (root / "examples" / f"{name}.py").read_text()
    assert len(source.splitlines()) <= 60
    tree = ast.parse(source)
    assert ast.get_docstring(tree)
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert {module for module in modules if module.startswith("latentplan")} <= PUBLIC
