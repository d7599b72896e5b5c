"""Objectives and constraints chosen after training: the language, its parser, and what a planner maximises for them."""
