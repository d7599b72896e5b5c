"""Relatives of the cross-entropy method: the same search with other settings."""

from __future__ import annotations

from typing import Any

from latentplan.planning.search.cem import CEMPlanner


def icem_planner(**settings: Any) -> CEMPlanner:
    """The improved CEM of Pinneri et al. 2020: coloured noise, elites kept and shifted, the best candidate executed.

    Args:
        **settings: Of `CEMPlanner`; they replace `noise_beta` 2, `keep_elite_fraction` 0.3 and `final` "best".
    """
    defaults: dict[str, Any] = {"noise_beta": 2.0, "keep_elite_fraction": 0.3, "final": "best"}
    return CEMPlanner(**defaults | settings)


def mppi_planner(**settings: Any) -> CEMPlanner:
    """MPPI (Williams et al. 2017): every candidate counts, weighted by exp(return / temperature); fixed variance.

    Args:
        **settings: Of `CEMPlanner`; they replace `temperature` 1, `smoothing` 1, `num_iterations` 1, `adapt_std` False
            and `num_elites`, all of `num_samples` (256).
    """
    num_samples = settings.get("num_samples", 256)
    defaults: dict[str, Any] = {"num_samples": num_samples, "num_elites": num_samples, "num_iterations": 1}
    defaults |= {"smoothing": 1.0, "temperature": 1.0, "adapt_std": False}
    return CEMPlanner(**defaults | settings)
