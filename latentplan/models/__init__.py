"""Networks: the world model and its parts."""

from latentplan.models.dynamics import Dynamics, Gaussian, Rssm, State, kl_divergence
from latentplan.models.world_model import WorldModel

__all__ = ["Dynamics", "Gaussian", "Rssm", "State", "WorldModel", "kl_divergence"]
