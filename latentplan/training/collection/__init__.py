"""Collection of experience, in the learner's process or in another one."""
