"""Elementwise functions are compiled only where torch can compile."""

import pytest
import torch

from latentplan.models.fast import pointwise


def test_can_compile_warns_once_when_torch_cannot_compile(monkeypatch):
    def broken(function, **options):
        raise RuntimeError("no C compiler\nand more")

    monkeypatch.setattr(torch, "compile", broken)
    pointwise.can_compile.cache_clear()
    try:
        with pytest.warns(RuntimeWarning, match="cannot compile here.*: no C compiler$"):
            assert pointwise.can_compile("cpu") is False
        assert pointwise.can_compile("cpu") is False  # without another warning
    finally:
        pointwise.can_compile.cache_clear()
