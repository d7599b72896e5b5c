"""Recorded episodes that a run learns from: this project's own files, Minari datasets and LeRobot datasets."""
