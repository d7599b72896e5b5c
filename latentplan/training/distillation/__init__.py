"""Teaching a trained agent's actor what its planner does."""
