"""Distillation of a trained agent's planner into its actor."""
