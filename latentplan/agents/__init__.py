"""Agents: a world model and a way to choose actions with it, and how an agent is kept."""
