"""Reads the files of a run folder."""

import csv

import torch


def read_rows(folder):
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def read_epochs(folder):
    """The rows of epochs, without the rows of evaluations."""
    return [row for row in read_rows(folder) if row["reconstruction"]]


def read_state(folder):
    return torch.load(folder / "resume" / "state.pt", weights_only=True)
