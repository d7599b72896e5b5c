"""The search over action sequences: its options, the loop, the planners by name, and the parts of the loop."""
