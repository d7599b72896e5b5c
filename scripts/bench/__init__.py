"""The benchmarks of `scripts/benchmark.py`.

Each command has a module of the same name: train, render, collect, decide, paths, plan, compile, ablate, zero_shot,
realtime, soak, learn, suite. Other modules hold a part of one command, with its name in front (also ablation_arms for
ablate, path_calls for paths), or are shared: anchors, estimates, machine, options, report, runs, workers. The package
peers holds planners of other libraries for plan; `readme_film.py` draws the film of the README.
"""
