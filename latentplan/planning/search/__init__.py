"""The search over action sequences: the loop, its parts, and the planners by name. Its options are in `config.search`."""
