"""Functions between products are compiled only where that works."""

import pytest
import torch

from latentplan.models.fast import pointwise


def test_where_torch_cannot_compile_it_says_so_once_and_goes_on(monkeypatch):
    def broken(function, **options):
        raise RuntimeError("no C compiler\nand more")

    monkeypatch.setattr(torch, "compile", broken)
    pointwise.can_compile.cache_clear()
    try:
        with pytest.warns(RuntimeWarning, match="cannot compile here.*: no C compiler$"):
            assert pointwise.can_compile("cpu") is False
        assert pointwise.can_compile("cpu") is False  # told once
    finally:
        pointwise.can_compile.cache_clear()
