"""The search over action sequences: the loop, its options, and its parts."""
