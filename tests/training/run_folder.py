"""Reads the files of a run folder."""

import csv

import torch


def rows_of(folder):
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def epochs_of(folder):
    """The rows of epochs, without the rows of evaluations."""
    return [row for row in rows_of(folder) if row["reconstruction"]]


def saved_state(folder):
    return torch.load(folder / "resume" / "state.pt", weights_only=True)
