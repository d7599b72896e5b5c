"""Every setting of latentplan: one frozen dataclass per component, built on the standard library alone."""

from latentplan.config.checks import MAX_THREADS, EnvironmentFault, UserError, derive_seed, make_folder, output_file
from latentplan.config.learning import CollectionConfig, DistillConfig, GoalsConfig, LearningConfig
from latentplan.config.planner import PlannerConfig, SearchOptions
from latentplan.config.settings import (
    DEVICES,
    FLOORS,
    LATENT_DIM,
    RENDER_QUALITIES,
    USER_DOMAIN,
    Config,
    Device,
    EnvConfig,
    EvaluationConfig,
    ModelConfig,
    ReplayConfig,
    RunConfig,
    Strategy,
    from_dict,
    to_dict,
)

__all__ = [
    "DEVICES",
    "FLOORS",
    "LATENT_DIM",
    "MAX_THREADS",
    "RENDER_QUALITIES",
    "USER_DOMAIN",
    "CollectionConfig",
    "Config",
    "Device",
    "DistillConfig",
    "EnvConfig",
    "EnvironmentFault",
    "EvaluationConfig",
    "GoalsConfig",
    "LearningConfig",
    "ModelConfig",
    "PlannerConfig",
    "ReplayConfig",
    "RunConfig",
    "SearchOptions",
    "Strategy",
    "UserError",
    "derive_seed",
    "from_dict",
    "make_folder",
    "output_file",
    "to_dict",
]
