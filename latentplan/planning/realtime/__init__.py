"""Plans that are searched beside the control loop."""
