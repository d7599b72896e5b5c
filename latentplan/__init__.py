"""latentplan: world models from pixels, and planning in their latent space."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from latentplan.agents.checkpoint import load_agent

__version__ = "0.3.0.dev0"
__all__ = ["__version__", "load_agent"]


def __getattr__(name: str) -> Any:
    """Import `load_agent` when it is first asked for, so that `import latentplan` does no work."""
    if name == "load_agent":
        from latentplan.agents.checkpoint import load_agent

        return load_agent
    raise AttributeError(f"module 'latentplan' has no attribute {name!r}")
