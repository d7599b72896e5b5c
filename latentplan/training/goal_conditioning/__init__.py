"""Teaching a trained agent to pursue goals that are named later."""
