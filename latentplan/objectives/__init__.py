"""Objectives and constraints chosen after training: the language, the parser, and the objectives of the planner."""
