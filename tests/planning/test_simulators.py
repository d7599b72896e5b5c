"""Planning models of simulators: MuJoCo in threads, and functions written in jax."""

import pickle
import sys
from types import SimpleNamespace
from typing import NamedTuple

import mujoco
import pytest
import torch

from latentplan.planning import (
    CEMPlanner,
    JaxModel,
    ModelPredictiveController,
    MuJoCoModel,
    check_model,
)

SLIDER = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="cart"><joint name="slide" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>
  </worldbody>
  <actuator>
    <motor joint="slide" ctrlrange="-2 3" ctrllimited="true"/>
    <general joint="slide" dyntype="filter"/>
  </actuator>
  <sensor><jointvel name="speed" joint="slide"/><jointpos name="place" joint="slide"/></sensor>
</mujoco>
"""


def cost(physics, action):
    return physics.qpos[:, 0].square() + 0.1 * physics.qvel[:, 0].square() + 0.01 * action.square().sum(dim=1)


@pytest.fixture(scope="module")
def mjmodel():
    return mujoco.MjModel.from_xml_string(SLIDER)


@pytest.fixture
def start(mjmodel):
    data = mujoco.MjData(mjmodel)
    data.qpos[0], data.qvel[0], data.time = 0.5, -0.25, 7.0
    return MuJoCoModel(mjmodel, cost).state(data)


def simulate(mjmodel, start, actions, substeps):
    """Cost and last position of a plain loop over `mj_step`."""
    data = mujoco.MjData(mjmodel)
    mujoco.mj_setState(mjmodel, data, start[0].numpy(), mujoco.mjtState.mjSTATE_FULLPHYSICS)
    costs = []
    for action in actions:
        costs.append(data.qpos[0] ** 2 + 0.1 * data.qvel[0] ** 2 + 0.01 * float(action.square().sum()))
        data.ctrl[:] = action.numpy()
        mujoco.mj_step(mjmodel, data, substeps)
    return costs, data.qpos[0]


@pytest.mark.parametrize("threads", [1, 3])
def test_mujoco_rollout_equals_a_loop_over_steps_of_the_simulator(mjmodel, start, threads):
    model = MuJoCoModel(mjmodel, cost, substeps=2, threads=threads)
    actions = torch.rand(5, 4, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rewards, last = model.rollout(start.expand(5, -1), actions)
    for row in range(5):
        costs, position = simulate(mjmodel, start, actions[row], substeps=2)
        torch.testing.assert_close(-rewards[row], torch.tensor(costs, dtype=torch.float64))
        torch.testing.assert_close(float(model.physics(last[row : row + 1]).qpos), position)


def test_mujoco_model_passes_the_check_of_models(mjmodel, start):
    model = MuJoCoModel(mjmodel, cost, lambda physics: physics.qpos[:, 0].square(), threads=2)
    assert check_model(model, start, model.action_dim) == ("value", "rollout")
    assert not hasattr(MuJoCoModel(mjmodel, cost), "value")


def test_mujoco_sensors_belong_to_the_state_before_the_step(mjmodel, start):
    def sensed(physics, action):
        torch.testing.assert_close(physics.sensors["speed"], physics.qvel)
        torch.testing.assert_close(physics.sensors["place"], physics.qpos)
        return physics.sensors["place"][:, 0]

    rewards, _ = MuJoCoModel(mjmodel, sensed, substeps=3).rollout(start, torch.ones(1, 3, 2, dtype=torch.float64))
    assert float(rewards[0, 0]) == -0.5
    assert len(set(rewards[0].tolist())) == 3


def test_mujoco_bounds_are_the_control_ranges(mjmodel):
    model = MuJoCoModel(mjmodel, cost)
    assert model.action_low.tolist() == [-2.0, -1.0]
    assert model.action_high.tolist() == [3.0, 1.0]


def test_mujoco_reads_parts_of_the_state_by_name(mjmodel, start):
    physics = MuJoCoModel(mjmodel, cost).physics(start)
    assert (float(physics.time), float(physics.qpos), float(physics.qvel)) == (7.0, 0.5, -0.25)
    assert physics.act.shape == (1, 1)


def test_mujoco_unstable_candidate_has_no_finite_return_and_is_never_chosen(mjmodel, start):
    model = MuJoCoModel(mjmodel, cost)
    broken = start.clone()
    broken[0, 2] = 1e12  # a velocity that MuJoCo refuses
    rewards, _ = model.rollout(torch.cat([start, broken]), torch.zeros(2, 3, 2, dtype=torch.float64))
    assert torch.isfinite(rewards[0]).all()
    assert torch.isnan(rewards[1]).all()


@pytest.mark.parametrize("threads", [1, 2])
def test_unstable_candidates_print_nothing_and_leave_the_handler_of_warnings(
    mjmodel, start, threads, capfd, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    stiff = mujoco.MjModel.from_xml_string(SLIDER.replace('axis="1 0 0"', 'axis="1 0 0" stiffness="1e8"'))
    seen = []
    mujoco.set_mju_user_warning(seen.append)
    try:
        rewards, _ = MuJoCoModel(stiff, cost, threads=threads).rollout(start.repeat(4, 1), torch.ones(4, 30, 2))
        assert rewards.isnan().any(1).all()
        assert seen == [] and capfd.readouterr() == ("", "") and not list(tmp_path.iterdir())
        data = mujoco.MjData(stiff)
        data.qpos[0] = 0.5
        mujoco.mj_step(stiff, data, 30)
        assert seen  # the caller's own simulation still warns
    finally:
        mujoco.set_mju_user_warning(None)


def test_models_and_data_of_dm_control_are_unwrapped(mjmodel):
    data = mujoco.MjData(mjmodel)
    data.qpos[0] = 0.5
    model = MuJoCoModel(SimpleNamespace(ptr=mjmodel), cost)  # as `physics.model` and `physics.data` have it
    assert model.physics(model.state(SimpleNamespace(ptr=data))).qpos.tolist() == [[0.5]]


def test_mujoco_control_drives_the_cart_to_the_origin(mjmodel, start):
    model = MuJoCoModel(mjmodel, cost, substeps=5, threads=2)
    planner = CEMPlanner(
        action_dim=2, horizon=20, num_samples=64, action_low=model.action_low, action_high=model.action_high
    )
    controller = ModelPredictiveController(planner, model, generator=torch.Generator().manual_seed(0))
    state = start
    for _ in range(40):
        state, _ = model.step(state, controller.act(state))
    assert abs(float(model.physics(state).qpos)) < 0.1


def test_mujoco_model_leaves_the_given_model_as_it_is(mjmodel):
    before = int(mjmodel.opt.disableflags)
    MuJoCoModel(mjmodel, cost)
    assert mjmodel.opt.disableflags == before


def test_mujoco_model_survives_pickling_after_use(mjmodel, start):
    model = MuJoCoModel(mjmodel, cost, threads=2)
    actions = torch.ones(1, 3, 2, dtype=torch.float64)
    rewards, last = model.rollout(start, actions)
    again, final = pickle.loads(pickle.dumps(model)).rollout(start, actions)
    assert torch.equal(rewards, again) and torch.equal(last, final)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda mjmodel: MuJoCoModel(mjmodel, cost, substeps=0), "substeps must be at least 1, got 0"),
        (lambda _: MuJoCoModel(mujoco.MjModel.from_xml_string("<mujoco/>"), cost), "no actuator"),
    ],
)
def test_mujoco_model_refuses_what_cannot_be_planned(mjmodel, make, message):
    with pytest.raises(ValueError, match=message):
        make(mjmodel)


def test_mujoco_model_names_the_shape_of_a_wrong_cost(mjmodel, start):
    with pytest.raises(ValueError, match=r"cost must return shape \(3,\), got \(3, 1\)"):
        MuJoCoModel(mjmodel, lambda physics, action: physics.qpos).rollout(start, torch.zeros(1, 3, 2))
    with pytest.raises(TypeError, match=r"cost must be a tensor of shape \(3,\), got float"):
        MuJoCoModel(mjmodel, lambda physics, action: 1.0).rollout(start, torch.zeros(1, 3, 2))
    with pytest.raises(TypeError, match=r"terminal_cost must be a tensor of shape \(1,\), got float"):
        MuJoCoModel(mjmodel, cost, lambda physics: 1.0).value(start)


@pytest.mark.parametrize("name", ["mujoco", "jax"])
def test_missing_library_is_one_line_that_names_the_extra(monkeypatch, mjmodel, name):
    monkeypatch.setitem(sys.modules, name, None)  # importing the library now fails
    with pytest.raises(ImportError, match=rf"needs {name}, .*: pip install 'latentplan\[\w+\]'$") as error:
        MuJoCoModel(mjmodel, cost) if name == "mujoco" else JaxModel(lambda state, action: (state, 0.0))
    assert "\n" not in str(error.value)


class Car(NamedTuple):
    place: torch.Tensor
    speed: torch.Tensor


def drive(car, action):  # numbers of one car; the rows are added by the model
    speed = car.speed + 0.1 * action[0]
    return Car(car.place + 0.1 * speed, speed), -(car.place**2) - 0.1 * car.speed**2


def test_jax_model_passes_the_check_of_models():
    pytest.importorskip("jax")
    state = Car(torch.tensor([0.5, -0.3]), torch.tensor([0.0, 0.2]))
    assert check_model(JaxModel(drive, lambda car: -(car.place**2)), state, 1) == ("value", "rollout")
    assert check_model(JaxModel(drive), state, 1) == ("rollout",)


def test_jax_model_equals_the_same_equations_in_torch():
    pytest.importorskip("jax")
    state = Car(torch.tensor([0.5, -0.3]), torch.tensor([0.0, 0.2]))
    actions = torch.rand(2, 6, 1, generator=torch.Generator().manual_seed(0))
    rewards, last = JaxModel(drive).rollout(state, actions)
    for step in range(6):
        state, reward = drive(state, actions[:, step].T)
        torch.testing.assert_close(rewards[:, step], reward)
    torch.testing.assert_close(last, state)


@pytest.mark.parametrize("method", ["step", "rollout"])
def test_gradient_through_jax_equals_the_gradient_of_the_same_equations_in_torch(method):
    pytest.importorskip("jax")
    start, given = (
        Car(torch.tensor([0.5, -0.3]), torch.tensor([0.0, 0.2])),
        torch.tensor([[[0.3], [-0.8]], [[0.1], [1.0]]]),
    )
    found = []
    for model in (JaxModel(drive), None):
        state, actions = Car(*(part.clone().requires_grad_() for part in start)), given.clone().requires_grad_()
        if model is not None and method == "rollout":
            rewards, last = model.rollout(state, actions)
            total = rewards.sum() + last.place.sum()
        else:
            current, total = state, 0.0
            for action in actions.unbind(1):
                current, reward = model.step(current, action) if model is not None else drive(current, action.T)
                total = total + reward.sum()
            total = total + current.place.sum()
        found.append(torch.autograd.grad(total, [*state, actions]))
    torch.testing.assert_close(found[0], found[1])


def test_gradient_planner_refines_plans_in_a_jax_model():
    pytest.importorskip("jax")
    model, state = JaxModel(drive), Car(torch.tensor([0.5]), torch.tensor([0.0]))
    sizes = {"action_dim": 1, "horizon": 20, "num_samples": 16, "num_iterations": 1}
    plain, refined = (
        CEMPlanner(**sizes, gradient_steps=steps).plan(model, state, generator=torch.Generator().manual_seed(0))
        for steps in (0, 10)
    )
    assert float(refined.expected_return) > float(plain.expected_return)


def test_gradient_planner_accepts_a_jax_state_with_a_counter():
    pytest.importorskip("jax")

    def count(state, action):
        position, steps = state
        return (position + 0.1 * action, steps + 1), -((position + 0.1 * action) ** 2).sum()

    model, state = JaxModel(count), (torch.ones(2, 1), torch.zeros(2, dtype=torch.int32))
    planner = CEMPlanner(action_dim=1, horizon=3, num_samples=16, num_elites=4, gradient_steps=5)
    plan = planner.plan(model, state, generator=torch.Generator().manual_seed(0))
    assert (plan.actions[:, 0] < 0).all()


def test_jax_model_keeps_the_order_of_dictionary_keys_and_strided_rows():
    pytest.importorskip("jax")
    model = JaxModel(lambda state, action: ({"a": state["a"], "z": state["z"] + action}, action.sum()))
    state = {"z": torch.zeros(1, 2).expand(3, 2), "a": torch.arange(3.0)}
    following, reward = model.step(state, torch.ones(3, 2))
    assert list(following) == ["z", "a"]
    assert following["z"].tolist() == [[1.0, 1.0]] * 3 and reward.tolist() == [2.0] * 3


def test_jax_control_stops_the_car():
    pytest.importorskip("jax")
    model = JaxModel(drive)
    planner = CEMPlanner(action_dim=1, horizon=20, num_samples=64)
    controller = ModelPredictiveController(planner, model, generator=torch.Generator().manual_seed(0))
    state = Car(torch.tensor([0.5]), torch.tensor([0.0]))
    for _ in range(60):
        state, _ = model.step(state, controller.act(state))
    assert abs(float(state.place)) < 0.1 and abs(float(state.speed)) < 0.2


def test_jax_model_names_the_setting_that_double_precision_needs():
    pytest.importorskip("jax")
    state = Car(torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
    with pytest.raises(TypeError, match="jax_enable_x64"):
        JaxModel(drive).step(state, torch.zeros(1, 1, dtype=torch.float64))


def test_jax_model_survives_pickling_after_use():
    pytest.importorskip("jax")
    model, state = JaxModel(drive), Car(torch.ones(1), torch.ones(1))
    model.step(state, torch.ones(1, 1))
    _, reward = pickle.loads(pickle.dumps(model)).step(state, torch.ones(1, 1))
    assert float(reward) == pytest.approx(-1.1)
