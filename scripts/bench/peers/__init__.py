"""Planners of other libraries on the same model, each in a process of its own, with an environment of their own."""
