"""Everything that is only speed: the same results as the plain models, sooner."""
