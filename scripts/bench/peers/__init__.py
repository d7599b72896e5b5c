"""Other planner libraries on the same model: where they live, each in a process of its own, and how they are asked."""
