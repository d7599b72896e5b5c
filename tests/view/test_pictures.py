"""Goal pictures: square PNG files that were sent, and no other file of the machine."""

import struct

import numpy as np
import pytest

from latentplan.config import UserError
from latentplan.objectives.goal_image import read_goal_image
from latentplan.reporting.page import encode_png
from latentplan.view.pictures import LARGEST_BYTES, LARGEST_SIDE, MOST_PICTURES, GoalPictures

PICTURE = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)


def test_picture_is_read_as_it_was_sent(tmp_path):
    pictures = GoalPictures(tmp_path)
    name = pictures.add(encode_png(PICTURE))
    text = pictures.resolve(f"0.5 * goal:{name} + 0.5 * (cart -> 0.1)")
    path = text.split('"')[1]
    assert text == f'0.5 * goal:"{path}" + 0.5 * (cart -> 0.1)'
    assert np.array_equal(read_goal_image(path), PICTURE)


def test_names_of_files_are_refused_unless_the_command_line_named_them(tmp_path):
    secret = tmp_path / "secret.png"
    secret.write_bytes(encode_png(PICTURE))
    with pytest.raises(UserError, match="there is no goal picture .*; there are: none was sent yet"):
        GoalPictures(tmp_path).resolve(f"goal:{secret}")
    allowed = GoalPictures(tmp_path, f"goal:{secret}")
    assert allowed.resolve(f'cart + goal:"{secret}"') == f'cart + goal:"{secret}"'
    assert allowed.resolve(None) is None and allowed.resolve("cart -> 1") == "cart -> 1"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "PNG file"),
        (b"GIF89a" + bytes(100), "PNG file"),
        (encode_png(PICTURE) + bytes(LARGEST_BYTES), "at most 2 MB"),
        (encode_png(PICTURE)[:60], "picture-1.png"),
        (encode_png(PICTURE[:32]), "must be square, got 64 x 32"),
        (encode_png(PICTURE)[:16] + struct.pack(">II", LARGEST_SIDE + 1, 4), "2048 x 2048"),
    ],
)
def test_content_that_is_no_square_png_is_refused_and_not_kept(tmp_path, content, words):
    pictures = GoalPictures(tmp_path)
    with pytest.raises(UserError) as error:
        pictures.add(content)
    assert words in str(error.value) and str(tmp_path) not in str(error.value)
    assert not pictures.contents and not list(tmp_path.iterdir())


def test_number_of_pictures_is_limited(tmp_path):
    pictures = GoalPictures(tmp_path)
    names = [pictures.add(encode_png(PICTURE)) for _ in range(MOST_PICTURES)]
    assert len(set(names)) == MOST_PICTURES
    with pytest.raises(UserError, match="20 goal pictures already"):
        pictures.add(encode_png(PICTURE))
