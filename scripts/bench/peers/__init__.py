"""Peers: planners of other libraries on the same model, each in its own process, in a separate Python environment."""
