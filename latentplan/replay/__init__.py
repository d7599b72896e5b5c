"""Experience: a ring of frames and what came with them."""
