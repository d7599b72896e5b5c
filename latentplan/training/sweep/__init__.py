"""Sweeps: many short runs that search for better settings."""
