"""The parts of `scripts/benchmark.py`: one module per command, and what they share."""
