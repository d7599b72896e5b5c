"""Goals named after training: a small language, and what a search maximises for it."""
