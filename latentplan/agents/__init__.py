"""Agents: how actions are chosen with a world model, and how agents are saved, loaded and exported."""
