"""The search over action sequences: the loop, its parts, and the planners by name; `config.planner` has its options."""
