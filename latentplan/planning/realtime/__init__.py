"""Planning in real time: searches that run beside the control loop."""
