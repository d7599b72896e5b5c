"""Replay: a ring buffer of frames, actions and rewards, and an estimate of its memory."""
