"""Films of episodes and figures of learning curves."""
