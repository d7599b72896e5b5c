"""Planners of this and other libraries in closed loop, each library in its own process."""
