"""Goal pictures that a page has sent, under the names by which objectives call them."""

from __future__ import annotations

import re
import struct
from pathlib import Path

from latentplan.config import UserError
from latentplan.config.checks import shown
from latentplan.objectives.goal_image import read_goal_image

LARGEST_BYTES = 2_000_000
LARGEST_SIDE = 2048  # pixels; a picture of few bytes may be of very many
MOST_PICTURES = 20
RULE = f"a goal picture must be a PNG file of at most {LARGEST_BYTES // 1_000_000} MB"
_PNG = b"\x89PNG\r\n\x1a\n"
_GOAL = re.compile(r'goal:(?P<name>"[^"]*"|[^\s();"]+)')


class GoalPictures:
    """Files of goal pictures. An objective can name these alone, so that a page reads no other file of the machine.

    Attributes:
        contents: The pictures that were sent, as contents of PNG files, by their names.

    Args:
        folder: Folder of the files.
        objective: Objective of the command line, whose own files may be named too.
    """

    def __init__(self, folder: Path, objective: str | None = None) -> None:
        self._folder = folder
        self.contents: dict[str, bytes] = {}
        self._paths = {name: name for name in _names(objective or "")}

    def add(self, content: bytes) -> str:
        """Keeps a picture and returns its name.

        Args:
            content: Content of a PNG file; the picture must be square.

        Raises:
            UserError: The content is no such picture, or there are too many.
        """
        if len(self.contents) >= MOST_PICTURES:
            raise UserError(f"there are {MOST_PICTURES} goal pictures already; start the program anew")
        if len(content) > LARGEST_BYTES or not content.startswith(_PNG) or len(content) < 24:
            raise UserError(RULE)
        if max(struct.unpack(">II", content[16:24])) > LARGEST_SIDE:
            raise UserError(f"a goal picture must have at most {LARGEST_SIDE} x {LARGEST_SIDE} pixels")
        name = f"picture-{len(self.contents) + 1}.png"
        path = self._folder / name
        path.write_bytes(content)
        try:
            read_goal_image(str(path))
        except UserError as error:
            path.unlink()
            raise UserError(str(error).replace(str(path), name)) from None
        self.contents[name], self._paths[name] = content, str(path)
        return name

    def drop_last(self) -> None:
        """Forgets the picture that was added last."""
        name, _ = self.contents.popitem()
        Path(self._paths.pop(name)).unlink()

    def resolve(self, objective: str | None) -> str | None:
        """The objective with the files of its pictures in place of their names.

        Raises:
            UserError: The objective names another picture.
        """
        return None if objective is None else _GOAL.sub(self._with_path, objective)

    def _with_path(self, found: re.Match[str]) -> str:
        name = found["name"].strip('"')
        if name not in self._paths:
            known = ", ".join(self._paths) or "none was sent yet"
            raise UserError(f"there is no goal picture {shown(name)}; there are: {known}")
        return f'goal:"{self._paths[name]}"'


def _names(objective: str) -> list[str]:
    """The pictures that an objective names."""
    return [found["name"].strip('"') for found in _GOAL.finditer(objective)]
