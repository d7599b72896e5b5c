"""The search over action sequences: the loop, its parts, and the planners by name; `config.search` has its options."""
