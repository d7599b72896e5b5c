"""Pictures of a goal that cannot be had are named in one line."""

import cv2
import pytest

from latentplan.config import UserError
from latentplan.objectives.image import read_goal


@pytest.mark.parametrize(
    ("name", "said"), [("nothing.png", "does not exist"), ("", "is a folder"), ("a" * 300 + ".png", "cannot be read")]
)
def test_a_file_that_is_none_is_named(tmp_path, name, said):
    with pytest.raises(UserError, match=said):
        read_goal(str(tmp_path / name))


def test_a_picture_beyond_what_can_be_read_is_named(tmp_path, monkeypatch):
    (tmp_path / "large.png").touch()

    def refuse(path, flags):
        raise cv2.error("(-215:Assertion failed) pixels <= CV_IO_MAX_IMAGE_PIXELS")

    monkeypatch.setattr(cv2, "imread", refuse)
    with pytest.raises(UserError, match="CV_IO_MAX_IMAGE_PIXELS"):
        read_goal(str(tmp_path / "large.png"))
