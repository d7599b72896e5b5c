import cv2
import numpy as np
import pytest

from latentplan.config import UserError
from latentplan.reporting.video import PANEL_SIZE, VideoWriter, compose_frame

SIZE = (96, 64)


def flat(level):
    return np.full((SIZE[1], SIZE[0], 3), level, np.uint8)


def picture(size, color):
    return np.full((size, size, 3), color, np.uint8)


def read_back(path):
    capture = cv2.VideoCapture(str(path))
    frames = []
    while True:
        found, frame = capture.read()
        if not found:
            return capture, frames
        frames.append(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))


@pytest.mark.parametrize(("suffix", "codec"), [(".mp4", b"vp09"), (".webm", b"V_VP9")])
def test_films_hold_what_was_written_in_vp9(tmp_path, suffix, codec):
    path = tmp_path / f"film{suffix}"
    with VideoWriter(path, 12.5, SIZE) as film:
        for time in range(9):
            film.write(flat(20 * time))
    capture, frames = read_back(path)
    assert codec in path.read_bytes()
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5, rel=0.01)
    levels = [frame.mean() for frame in frames]
    assert levels == pytest.approx([20 * time for time in range(9)], abs=4)  # lossy


def test_films_keep_colours_in_their_channels(tmp_path):
    with VideoWriter(tmp_path / "red.mp4", 10, SIZE) as film:
        film.write(np.full((SIZE[1], SIZE[0], 3), (220, 20, 60), np.uint8))
    _, (frame,) = read_back(tmp_path / "red.mp4")
    assert frame.mean(axis=(0, 1)) == pytest.approx([220, 20, 60], abs=8)  # lossy


def test_a_composed_film_looks_as_composed(tmp_path):
    composed = [
        compose_frame(picture(256, (200, 30, 30)), picture(64, (30, 30, 25 * t)), [f"return {t}"], horizon=6)
        for t in range(8)
    ]
    height, width = composed[0].shape[:2]
    with VideoWriter(tmp_path / "film.mp4", 20, (width, height)) as film:
        for frame in composed:
            film.write(frame)
    _, frames = read_back(tmp_path / "film.mp4")
    assert len(frames) == 8
    errors = [np.abs(a.astype(int) - b).mean() for a, b in zip(frames, composed, strict=True)]
    assert max(errors) < 6  # of 255; a swapped or shifted panel is off by 50


@pytest.mark.parametrize("wrong", [np.zeros((64, 64, 3), np.uint8), np.zeros((64, 96, 3), np.float32)])
def test_frames_of_another_size_or_type_are_refused(tmp_path, wrong):
    with pytest.raises(ValueError, match="uint8"), VideoWriter(tmp_path / "film.mp4", 20, SIZE) as film:
        film.write(wrong)


@pytest.mark.parametrize(("fps", "size"), [(0, SIZE), (float("nan"), SIZE), (20, (95, 64)), (20, (96, 0))])
def test_impossible_films_are_refused(tmp_path, fps, size):
    with pytest.raises(ValueError, match="fps|even"):
        VideoWriter(tmp_path / "film.mp4", fps, size)


@pytest.mark.parametrize("name", ["film.avi", "film", "film.mp4.txt"])
def test_other_endings_are_refused_by_name(tmp_path, name):
    with pytest.raises(UserError, match=r"\.mp4 or \.webm"):
        VideoWriter(tmp_path / name, 20, SIZE)


def test_a_missing_folder_is_an_error_at_once(tmp_path):
    with pytest.raises(OSError, match="cannot open"):
        VideoWriter(tmp_path / "nowhere" / "film.mp4", 20, SIZE)


def test_an_empty_film_is_an_error_and_no_file(tmp_path):
    with pytest.raises(OSError, match="no frame"), VideoWriter(tmp_path / "film.mp4", 20, SIZE):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_film_cut_short_on_disk_is_noticed(tmp_path):
    with pytest.raises(OSError, match="of 6 frames"), VideoWriter(tmp_path / "film.mp4", 20, SIZE) as film:
        for time in range(5):
            film.write(flat(time))
        film.num_frames += 1
    assert list(tmp_path.iterdir()) == []


def test_a_failed_block_leaves_the_older_film(tmp_path):
    path = tmp_path / "film.mp4"
    path.write_bytes(b"older")
    with pytest.raises(RuntimeError, match="halfway"), VideoWriter(path, 20, SIZE) as film:
        film.write(flat(0))
        raise RuntimeError("halfway")
    assert path.read_bytes() == b"older"
    assert [entry.name for entry in tmp_path.iterdir()] == ["film.mp4"]


def test_the_real_picture_is_left_and_the_imagined_right():
    frame = compose_frame(picture(256, (200, 0, 0)), picture(64, (0, 0, 200)), ["return 1"], horizon=6)
    left, right = np.split(frame[: PANEL_SIZE + 40], 2, axis=1)
    assert (left == (200, 0, 0)).all(axis=2).sum() == PANEL_SIZE**2
    assert (right == (0, 0, 200)).all(axis=2).sum() == PANEL_SIZE**2


@pytest.mark.parametrize("size", [64, 84, 256, 257, 300])
@pytest.mark.parametrize("imagined", [None, picture(64, (9, 9, 9))])
def test_composed_frames_have_even_sides_and_room_for_256_pixels(size, imagined):
    frame = compose_frame(picture(size, (1, 2, 3)), imagined, ["one", "two"])
    assert frame.dtype == np.uint8
    assert frame.shape[0] % 2 == frame.shape[1] % 2 == 0
    assert (frame == (1, 2, 3)).all(axis=2).sum() >= PANEL_SIZE**2


def test_the_size_of_a_frame_does_not_depend_on_the_plan():
    real = picture(256, (1, 2, 3))
    assert compose_frame(real, None, ["a"]).shape == compose_frame(real, picture(64, (9, 9, 9)), ["b"], horizon=3).shape


def test_the_horizon_is_printed():
    real, imagined = picture(256, (0, 0, 0)), picture(64, (0, 0, 0))
    frames = [compose_frame(real, imagined, [], horizon=horizon) for horizon in (None, 1, 6, 12)]
    assert len({frame.tobytes() for frame in frames}) == 4


def test_where_there_is_no_plan_the_frame_says_why():
    real = picture(256, (0, 0, 0))
    assert (compose_frame(real, None, [], absence="no plan") != compose_frame(real, None, [], absence="over")).any()


def test_text_stays_out_of_the_pictures_and_inside_the_frame():
    real = picture(256, (200, 0, 0))
    long = compose_frame(real, real[::4, ::4], ["WWW" * 100, "ggg" * 100], horizon=10**40)
    assert (long == (200, 0, 0)).all(axis=2).sum() == 2 * PANEL_SIZE**2
    border = np.concatenate([long[:2].reshape(-1, 3), long[-2:].reshape(-1, 3), long[:, :4].reshape(-1, 3)])
    assert (border == long[0, 0]).all()
    assert (long[:, -4:] == long[0, 0]).all()


def test_a_relative_name_may_hold_a_colon(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with VideoWriter("18:30.mp4", 12.5, SIZE) as film:
        film.write(flat(100))
    assert len(read_back(tmp_path / "18:30.mp4")[1]) == 1
