"""Models as people write them: in-place steps, sampling steps, dataclass states, proposals without a policy."""

import contextlib
import dataclasses
import pickle

import pytest
import torch

from latentplan.planning import (
    BackgroundPlanner,
    CEMPlanner,
    FunctionModel,
    ModelPredictiveController,
    check_model,
    compile_rollout,
)
from latentplan.planning.search.purity import FirstSearches


class InPlace:
    """A point mass whose step writes into the state."""

    def step(self, state, action):
        state += 0.1 * action
        return state, -state.square().sum(dim=1)


class InPlaceNumpy:
    """The same through NumPy, which no version counter of torch sees."""

    def step(self, state, action):
        array = state.numpy()
        array += 0.1 * action.numpy()
        return state, torch.from_numpy(-(array**2).sum(axis=1))


class InPlaceAction:
    """A step that clips its action in place."""

    def step(self, state, action):
        following = state + 0.1 * action.clamp_(-0.5, 0.5)
        return following, -following.square().sum(dim=1)


class InPlaceRollout(InPlace):
    """A rollout that writes into the start."""

    def rollout(self, state, actions):
        state += actions.sum(dim=1)
        return -state.square().sum(dim=1, keepdim=True).expand(-1, actions.shape[1]), state


@pytest.mark.parametrize("batch", [1, 2, 5])
@pytest.mark.parametrize(
    ("model", "what"),
    [(InPlace(), "state"), (InPlaceNumpy(), "state"), (InPlaceAction(), "action"), (InPlaceRollout(), "state")],
)
def test_model_that_writes_into_its_inputs_is_named_at_the_first_call(make_planner, model, what, batch):
    with pytest.raises(ValueError, match=f"{type(model).__name__} writes into the {what} it is given"):
        make_planner().plan(model, torch.ones(batch, 2))


def test_models_are_watched_once_per_planner(point, states, make_planner, monkeypatch):
    copies = []
    monkeypatch.setattr("latentplan.planning.search.loop.Watch.check", lambda watch, model, *_: copies.append(model))
    planner = make_planner()
    for _ in range(3):
        planner.plan(point, states)
    assert copies == [point]
    planner.plan(FunctionModel(point.dynamics, point.reward), states)
    dataclasses.replace(planner, horizon=3).plan(point, states)
    assert len(copies) == 3


@pytest.mark.parametrize("options", [{"objective": lambda rollout: 1 / 0}, {"deadline_ms": 0.0}])
def test_model_that_writes_into_its_state_is_named_when_the_first_call_scored_nothing(make_planner, options):
    planner, model = make_planner(), InPlace()
    with contextlib.suppress(ZeroDivisionError):
        planner.plan(model, torch.ones(2, 2), **options)
    with pytest.raises(ValueError, match="InPlace writes into the state"):
        planner.plan(model, torch.ones(2, 2))


def test_first_searches_keep_no_model_alive_and_know_no_later_one():
    seen = FirstSearches()
    model = InPlace()
    assert seen.add(model) and not seen.add(model)
    del model
    assert not seen._seen
    assert pickle.loads(pickle.dumps(seen)).add(seen)


def noisy_step(state, action, generator):
    noise = torch.randn(state.shape, generator=generator)
    return state + 0.1 * action + 0.05 * noise


@pytest.mark.parametrize("options", [{}, {"final": "better", "keep_elite_fraction": 0.5}])
def test_plans_in_a_sampling_model_repeat_when_its_step_takes_a_generator(states, make_planner, seeded, options):
    model = FunctionModel(noisy_step, lambda state, action: -state.square().sum(dim=1))
    start = states[:, :2]
    before = torch.random.get_rng_state()
    plans = [make_planner(**options).plan(model, start, generator=seeded(seed)) for seed in (0, 0, 1)]
    assert torch.equal(before, torch.random.get_rng_state())  # nothing came from the global stream
    assert torch.equal(plans[0].actions, plans[1].actions) and not torch.equal(plans[0].actions, plans[2].actions)
    controllers = [ModelPredictiveController(make_planner(), model, generator=seeded(3)) for _ in range(2)]
    for _ in range(3):
        assert torch.equal(*(controller.act(start) for controller in controllers))
    check_model(model, start, 2)


def test_rollout_that_samples_takes_the_generator_too(make_planner, seeded):
    class Rollout:
        def step(self, state, action, generator):
            raise AssertionError("the rollout is enough")

        def rollout(self, state, actions, generator):
            return torch.randn(actions.shape[:2], generator=generator), state

    plans = [make_planner().plan(Rollout(), torch.zeros(2, 1), generator=seeded()) for _ in range(2)]
    assert torch.equal(plans[0].actions, plans[1].actions)


class NoisyNetwork(torch.nn.Module):
    def forward(self, state, action, generator=None):
        return noisy_step(state, action, generator)


def test_module_that_samples_is_given_the_generator(states, make_planner, seeded):
    model = FunctionModel(NoisyNetwork(), lambda state, action: -state.square().sum(dim=1))
    plans = [make_planner().plan(model, states[:, :2], generator=seeded()) for _ in range(2)]
    assert torch.equal(plans[0].actions, plans[1].actions)


def keyword_step(state, action, *, generator):
    return noisy_step(state, action, generator)


def test_dynamics_may_take_the_generator_by_name_only(states, make_planner, seeded):
    plans = [
        make_planner().plan(FunctionModel(step, lambda state, action: action[:, 0]), states[:, :2], generator=seeded())
        for step in (noisy_step, keyword_step)
    ]
    assert torch.equal(plans[0].actions, plans[1].actions)


def test_compile_rollout_refuses_a_model_that_samples():
    with pytest.raises(ValueError, match="a model that does not sample"):
        compile_rollout(FunctionModel(noisy_step, lambda state, action: -state.square().sum(dim=1)))


def test_search_after_one_that_found_nothing_finite_is_as_long_as_a_cold_one(states, make_planner, seeded):
    is_broken = [True]

    def reward(state, action):
        return -state.square().sum(dim=1) * (float("nan") if is_broken else 1.0)

    planner = dataclasses.replace(make_planner(num_iterations=6), warm_start_iterations=2)
    model = FunctionModel(lambda state, action: state + 0.1 * action, reward)
    plan = planner.plan(model, states[:, :2], generator=seeded())
    assert plan.info["is_fallback"].all() and not plan.is_warm.any()
    is_broken.clear()
    plan = planner.plan(model, states[:, :2], plan, generator=seeded())
    assert plan.info["iterations"].tolist() == [6] * 5 and plan.is_warm.all()


@dataclasses.dataclass
class Body:
    position: torch.Tensor
    velocity: torch.Tensor


@dataclasses.dataclass(frozen=True)
class World:
    body: Body
    time: torch.Tensor


class BodyModel:
    """A point mass whose state is a dataclass in a dataclass."""

    def step(self, state, action):
        velocity = state.body.velocity + 0.3 * action
        position = state.body.position + 0.3 * velocity
        return World(Body(position, velocity), state.time + 1), -position.square().sum(dim=1)


def test_dataclass_states_plan_like_tensors(point, make_planner, seeded):
    position, velocity = torch.randn(2, 3, 2, generator=seeded())
    world = World(Body(position, velocity), torch.zeros(3))
    plan = make_planner().plan(BodyModel(), world, generator=seeded(), keep="states")
    plain = FunctionModel(
        point.dynamics, lambda state, action: -(state[:, :2] + 0.3 * (state[:, 2:] + 0.3 * action)).square().sum(dim=1)
    )
    expected = make_planner().plan(plain, torch.cat([position, velocity], dim=1), generator=seeded())
    torch.testing.assert_close(plan.actions, expected.actions)
    assert plan.candidates[0].states.body.position.shape == (3, 64, 6, 2)
    check_model(BodyModel(), world, 2)
    with BackgroundPlanner(make_planner(), BodyModel(), worker="thread") as background:
        assert background.request(world, 0)


def test_dataclass_state_may_come_with_the_last_action_at_the_first_call():
    @dataclasses.dataclass
    class Place:
        position: torch.Tensor

    class Mover:
        def step(self, state, action):
            return Place(state.position + action), -state.position.square().sum(dim=1)

    planner = CEMPlanner(action_dim=2, horizon=3, num_samples=8)
    plan = planner.plan(Mover(), Place(torch.zeros(1, 2)), last_action=torch.zeros(1, 2))
    assert torch.isfinite(plan.action).all()


def test_dataclass_with_other_fields_is_refused():
    @dataclasses.dataclass
    class Named:
        position: torch.Tensor
        name: str

    with pytest.raises(TypeError, match="holds a str"):
        CEMPlanner(action_dim=2).plan(BodyModel(), Named(torch.zeros(1, 2), "robot"))


class Proposer:
    """A model with proposals and no policy: only 0.625 has a reward."""

    def step(self, state, action):
        return state, (action - 0.625).abs().amax(dim=1).lt(1e-6).float()

    def propose(self, state, num, horizon, generators):
        return torch.full((len(state) * num, horizon, 2), 0.625)


@pytest.mark.parametrize("options", [{}, {"num_policy_samples": None}, {"num_policy_samples": 4, "tail": "policy"}])
def test_proposals_without_a_policy_are_candidates(make_planner, seeded, options):
    check_model(Proposer(), torch.zeros(2, 1), 2)
    planner = make_planner(**{"num_policy_samples": 4, "final": "best"} | options)
    plan = planner.plan(Proposer(), torch.zeros(2, 1), generator=seeded())
    assert (plan.actions == 0.625).all()
    assert (planner.plan(Proposer(), torch.zeros(2, 1), plan, generator=seeded()).actions == 0.625).all()


def test_proposals_without_a_policy_act_when_there_is_no_time(make_planner):
    plan = make_planner(num_policy_samples=4).plan(Proposer(), torch.zeros(2, 1), deadline_ms=0.0)
    assert (plan.actions == 0.625).all() and plan.source == "actor"


def test_num_samples_alone_is_enough():
    planner = CEMPlanner(action_dim=1, num_samples=20)
    assert (
        planner.num_best == 2
        and CEMPlanner(action_dim=1).num_best == 16
        and CEMPlanner(action_dim=1, num_samples=1).num_best == 1
    )
    planner.plan(FunctionModel(lambda state, action: state, lambda state, action: action[:, 0]), torch.zeros(1, 1))


def test_errors_of_a_first_search_say_what_to_do(make_planner):
    table = torch.zeros(3)
    cases = {
        "got a tuple of 5; of a gymnasium step, return the first two": lambda s, a: (s, a[:, 0], False, False, {}),
        r"must have shape .*state\[None\]": lambda s, a: (s, a),
        "must be a tensor": lambda s, a: (s, 1.0),
        "indices": lambda s, a: (s, table[a[:, 0]]),
    }
    for message, step in cases.items():
        model = type("Mine", (), {"step": staticmethod(step)})()
        with pytest.raises((ValueError, TypeError, IndexError), match=message) as caught:
            make_planner().plan(model, torch.zeros(2, 4))
        assert "check_model" in caught.value.__notes__[0]


@pytest.mark.parametrize("has_rollout", [False, True])
def test_states_of_another_number_of_rows_are_refused(point, states, make_planner, has_rollout):
    model = FunctionModel(lambda state, action: point.dynamics(state, action)[:1], point.reward)
    if has_rollout:
        model.rollout = lambda state, actions: (torch.zeros(actions.shape[:2]), state[:1])
    with pytest.raises(ValueError, match="returned a state of shape"):
        make_planner().plan(model, states)


@pytest.mark.parametrize(
    ("policy", "error", "message"),
    [
        (lambda state, generator: torch.zeros(len(state)), ValueError, r"policy\(\) must have shape"),
        (lambda state, generator: torch.zeros(len(state), 1, 2), ValueError, r"policy\(\) must have shape"),
        (lambda state, generator: (torch.zeros(len(state), 2),) * 2, TypeError, r"policy\(\) must be a tensor"),
        (
            lambda state, generator: torch.zeros(len(state), 2 if generator is None else 3),
            ValueError,
            r"policy\(\) must have shape",
        ),
    ],
)
def test_policy_of_another_shape_or_type_is_named(point, states, make_planner, policy, error, message):
    model = FunctionModel(point.dynamics, point.reward, policy=policy)
    with pytest.raises(error, match=message):
        make_planner(num_policy_samples=4).plan(model, states)


def test_previous_plan_that_is_no_plan_is_refused_with_the_remedy(point, states, make_planner):
    planner = make_planner()
    with pytest.raises(TypeError, match=r"must be a Plan, got Tensor; Plan.around\(actions\) makes one"):
        planner.plan(point, states, planner.plan(point, states).actions)
