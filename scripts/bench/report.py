"""Results as text tables, JSON, CSV and figures."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from latentplan.config import UserError
from latentplan.config.writing import replaced_whole, write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A text table; the first column is left-aligned, the others are right-aligned."""
    widths = [max(len(line[column]) for line in (header, *rows)) for column in range(len(header))]
    return "\n".join(_aligned(line, widths) for line in (header, ["-" * width for width in widths], *rows))


def format_number(value: float | None, digits: int = 1, sign: bool = False) -> str:
    """A number for a table; `-` for None and NaN."""
    if value is None or math.isnan(value):
        return "-"
    return f"{value:{'+' if sign else ''},.{digits}f}"


def format_interval(ends: Sequence[float | None], digits: int = 1, sign: bool = False) -> str:
    """An interval for a table; `-` if an end is None."""
    low, high = ends
    if low is None or high is None:
        return "-"
    return f"{format_number(low, digits, sign)} to {format_number(high, digits, sign)}"


def write_json(path: Path | None, result: Mapping[str, Any]) -> None:
    """Writes a result as JSON, if there is a path; numbers that are not finite become null, as JSON has none."""
    if path is not None:
        write_text(path, json.dumps(_finite(result), indent=2, allow_nan=False) + "\n")


def write_csv(path: Path | None, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes rows as CSV with the columns of the first row, if there is a path; the file is replaced as a whole."""
    if path is None:
        return
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def write_text(path: Path, text: str) -> None:
    """Writes a text; the file is replaced as a whole."""
    try:
        write_whole(path, text)
    except OSError as error:
        raise UserError(f"{path} could not be written: {error}") from error


def save_figure(figure: Figure, png: Path) -> None:
    """Writes a figure as PNG in place of a file."""
    with replaced_whole(png) as part:
        figure.savefig(part, dpi=120, format="png")


def _finite(value: Any) -> Any:
    """A plain value with None in place of numbers that are not finite."""
    if isinstance(value, Mapping):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _aligned(line: Sequence[str], widths: Sequence[int]) -> str:
    first, *others = zip(line, widths, strict=True)
    return "  ".join([f"{first[0]:<{first[1]}}", *(f"{text:>{width}}" for text, width in others)]).rstrip()
