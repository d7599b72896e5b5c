"""The learner: losses, optimizers, and the module that updates world model and behaviour."""
