"""A page in the browser that shows a running simulation and the agent's plans, and changes both."""
