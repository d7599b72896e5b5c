"""The refit equation on a worked example, and with returns that are not finite."""

import pytest
import torch

from latentplan.planning import refit
from latentplan.planning.search.elites import Scores, select_elites

CANDIDATES = torch.tensor([[0.5, 0.8], [-0.5, 0.2], [0.8, 0.6], [-1.0, -0.5]], dtype=torch.float64)[..., None]
RETURNS = torch.tensor([3.2, 1.0, 4.0, -0.5], dtype=torch.float64)
MEAN, VAR = torch.zeros(2, 1, dtype=torch.float64), torch.ones(2, 1, dtype=torch.float64)


def is_worked_example(mean, var):
    expected_mean = torch.tensor([[0.52], [0.56]], dtype=torch.float64)
    expected_var = torch.tensor([[0.2180], [0.2080]], dtype=torch.float64)
    return torch.allclose(mean, expected_mean, atol=1e-9) and torch.allclose(var, expected_var, atol=1e-9)


def test_refit_gives_the_worked_example_exactly():
    mean, var = refit(CANDIDATES, RETURNS, MEAN, VAR, num_elites=2, smoothing=0.8)
    assert is_worked_example(mean, var)
    assert mean[0].item() == pytest.approx(0.52, abs=1e-12)


def test_refit_gives_the_worked_example_in_every_environment_when_batched():
    batch = (CANDIDATES.expand(3, 4, 2, 1), RETURNS.expand(3, 4), MEAN.expand(3, 2, 1), VAR.expand(3, 2, 1))
    mean, var = refit(*batch, num_elites=2, smoothing=0.8)
    assert all(is_worked_example(mean[i], var[i]) for i in range(3))


@pytest.mark.parametrize("broken", [float("nan"), float("inf"), float("-inf")])
def test_refit_ignores_nonfinite_returns(broken):
    returns = torch.tensor([3.2, 1.0, broken, -0.5], dtype=torch.float64)
    mean, var = refit(CANDIDATES, returns, MEAN, VAR, num_elites=2, smoothing=1.0)
    expected = CANDIDATES[[0, 1]]
    torch.testing.assert_close(mean, expected.mean(dim=0))
    torch.testing.assert_close(var, expected.var(dim=0, correction=0))


def test_refit_uses_only_finite_candidates_when_fewer_than_elites():
    returns = torch.tensor([float("nan"), 1.0, float("nan"), float("nan")], dtype=torch.float64)
    mean, var = refit(CANDIDATES, returns, MEAN, VAR, num_elites=3, smoothing=1.0)
    torch.testing.assert_close(mean, CANDIDATES[1])
    torch.testing.assert_close(var, torch.zeros_like(var))


@pytest.mark.parametrize("temperature", [None, 0.5])
def test_refit_keeps_the_distribution_when_no_return_is_finite(temperature):
    returns = torch.full((4,), float("nan"), dtype=torch.float64)
    mean, var = refit(CANDIDATES, returns, MEAN, VAR, num_elites=2, smoothing=0.8, temperature=temperature)
    torch.testing.assert_close(mean, MEAN)
    torch.testing.assert_close(var, VAR)


@pytest.mark.parametrize("low", [-1e15, -1e25, -1e38])
def test_refit_weighs_returns_whose_squares_overflow(low):
    """Where dynamics diverge, one return may be lower than the others by many powers of ten."""
    returns = torch.tensor([1.0, 2.0, low, float("nan")])
    candidates, mean, var = CANDIDATES.float(), MEAN.float(), VAR.float()
    new_mean, _ = refit(candidates, returns, mean, var, num_elites=4, smoothing=1.0, temperature=0.1)
    torch.testing.assert_close(new_mean, candidates[:2].mean(dim=0))


def test_refit_ignores_a_nan_action_without_finite_return():
    candidates = CANDIDATES.clone()
    candidates[3] = float("nan")
    returns = torch.tensor([1.0, 2.0, float("nan"), float("nan")], dtype=torch.float64)
    mean, var = refit(candidates, returns, MEAN, VAR, num_elites=4, smoothing=0.5)
    assert torch.isfinite(mean).all() and torch.isfinite(var).all()


def test_refit_gives_variance_zero_for_one_elite():
    mean, var = refit(CANDIDATES, RETURNS, MEAN, VAR, num_elites=1, smoothing=1.0)
    torch.testing.assert_close(mean, CANDIDATES[2])
    torch.testing.assert_close(var, torch.zeros_like(var))


def test_refit_weighs_by_the_exponential_of_the_return_over_temperature_and_spread():
    weights = torch.softmax(RETURNS / (0.7 * RETURNS.std(correction=0)), dim=0)[:, None, None]
    mean, _ = refit(CANDIDATES, RETURNS, MEAN, VAR, num_elites=4, smoothing=1.0, temperature=0.7)
    torch.testing.assert_close(mean, (weights * CANDIDATES).sum(dim=0))


def test_refit_with_temperature_is_the_same_when_returns_are_shifted():
    shifted = refit(CANDIDATES, RETURNS + 1e6, MEAN, VAR, num_elites=4, smoothing=1.0, temperature=0.7)
    plain = refit(CANDIDATES, RETURNS, MEAN, VAR, num_elites=4, smoothing=1.0, temperature=0.7)
    torch.testing.assert_close(shifted, plain, atol=1e-6, rtol=0)


def test_refit_ignores_the_order_of_the_candidates():
    order = torch.tensor([3, 1, 0, 2])
    left = refit(CANDIDATES[order], RETURNS[order], MEAN, VAR, num_elites=2, smoothing=0.8)
    assert is_worked_example(*left)


def test_refit_names_shapes_that_do_not_fit():
    with pytest.raises(ValueError, match="do not fit"):
        refit(CANDIDATES, RETURNS[:3], MEAN, VAR, num_elites=2, smoothing=0.8)
    with pytest.raises(ValueError, match="num_elites"):
        refit(CANDIDATES, RETURNS, MEAN, VAR, num_elites=5, smoothing=0.8)


@pytest.mark.parametrize("value", [-1.0, 0.0, 0.1, 1e30])
@pytest.mark.parametrize("violations", [None, torch.zeros(1, 8), torch.ones(1, 8)])
def test_select_elites_weighs_equal_scores_alike(value, violations):
    returns = torch.full((1, 8), value)
    returns[0, -1] = torch.nan
    elites = select_elites(torch.zeros(1, 8, 3, 2), Scores(returns, violations), num_elites=8, temperature=0.1)
    torch.testing.assert_close(elites.weights, torch.tensor([[1 / 7] * 7 + [0.0]]))


def test_select_elites_ranks_and_weighs_feasible_candidates_first():
    violations = torch.tensor([[0.0, 0.0, 2.0, 1.0]], dtype=torch.float64)
    scores = Scores(RETURNS[None], violations)
    order = select_elites(CANDIDATES[None], scores, num_elites=4, temperature=None)
    assert order.scores.returns.tolist() == [[3.2, 1.0, -0.5, 4.0]]
    weighted = select_elites(CANDIDATES[None], scores, num_elites=4, temperature=1.0)
    torch.testing.assert_close(
        weighted.weights[0, :2], torch.softmax(RETURNS[:2] / RETURNS[:2].std(correction=0), dim=0)
    )
    assert (weighted.weights[0, 2:] == 0).all()
    none = select_elites(CANDIDATES[None], Scores(RETURNS[None], violations + 1), num_elites=4, temperature=1.0)
    least = -torch.tensor([1.0, 1.0, 2.0, 3.0]).double()
    torch.testing.assert_close(none.weights[0], torch.softmax(least / least.std(correction=0), dim=0))


def test_refit_accepts_integer_returns_and_mixed_precisions():
    candidates = torch.randn(6, 3, 2, generator=torch.Generator().manual_seed(0))
    numbers, zeros = torch.tensor([3, 1, 4, 1, 5, 9]), torch.zeros(3, 2, dtype=torch.float64)
    settings = {"num_elites": 2, "smoothing": 0.8}
    mean, var = refit(candidates, numbers, zeros, zeros + 1.0, **settings)
    expected = refit(candidates.double(), numbers.double(), zeros, zeros + 1.0, **settings)
    assert mean.dtype == torch.float64
    torch.testing.assert_close((mean, var), expected)


@pytest.mark.parametrize("setting", [{"smoothing": 5.0}, {"smoothing": 0.0}, {"smoothing": 0.8, "temperature": -1.0}])
def test_refit_refuses_numbers_out_of_range(setting):
    numbers = torch.zeros(4, 1, 1)
    with pytest.raises(ValueError, match=r"smoothing must lie in \(0, 1\] and temperature above 0"):
        refit(numbers, numbers[:, 0, 0], numbers[0], numbers[0], num_elites=2, **setting)
