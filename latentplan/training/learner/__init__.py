"""What one update learns: losses, optimizers, and the module that applies them."""
