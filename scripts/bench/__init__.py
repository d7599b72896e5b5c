"""The benchmarks of `scripts/benchmark.py`.

One module per command: train, render, decide, plan, compile, ablate, zero_shot, realtime, soak, learn. A module whose
name begins with the name of a command holds a part of it; machine, options, report and statistics are shared.
"""
