"""Goal conditioning: a trained agent learns to pursue goals that are named after training."""
