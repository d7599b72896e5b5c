"""The options that every planner of the search takes; declared in `latentplan.config.search`, below this library."""

from latentplan.config.search import SearchOptions

__all__ = ["SearchOptions"]
