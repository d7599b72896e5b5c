"""Video files hold all written frames, or are not created."""

import cv2
import numpy as np
import pytest

from latentplan.config import UserError
from latentplan.reporting.frame import compose_frame
from latentplan.reporting.video import VideoWriter, read_frames

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
def test_video_writer_writes_every_frame_in_vp9(tmp_path, suffix, codec):
    path = tmp_path / f"film{suffix}"
    with VideoWriter(path, 12.5, SIZE) as film:
        for time in range(9):
            film.write(flat(20 * time))
    capture, frames = read_back(path)
    assert codec in path.read_bytes()
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5, rel=0.01)
    levels = [frame.mean() for frame in frames]
    assert levels == pytest.approx([20 * time for time in range(9)], abs=4)  # lossy


def test_video_writer_keeps_colour_channels(tmp_path):
    with VideoWriter(tmp_path / "red.mp4", 10, SIZE) as film:
        film.write(np.full((SIZE[1], SIZE[0], 3), (220, 20, 60), np.uint8))
    _, (frame,) = read_back(tmp_path / "red.mp4")
    assert frame.mean(axis=(0, 1)) == pytest.approx([220, 20, 60], abs=8)  # lossy


def test_video_writer_keeps_the_look_of_composed_frames(tmp_path):
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
def test_video_writer_refuses_frames_of_another_size_or_type(tmp_path, wrong):
    with pytest.raises(ValueError, match="uint8"), VideoWriter(tmp_path / "film.mp4", 20, SIZE) as film:
        film.write(wrong)


@pytest.mark.parametrize(("fps", "size"), [(0, SIZE), (float("nan"), SIZE), (20, (95, 64)), (20, (96, 0))])
def test_video_writer_refuses_a_wrong_rate_or_odd_size(tmp_path, fps, size):
    with pytest.raises(ValueError, match="fps|even"):
        VideoWriter(tmp_path / "film.mp4", fps, size)


@pytest.mark.parametrize("name", ["film.avi", "film", "film.mp4.txt"])
def test_video_writer_refuses_other_file_endings(tmp_path, name):
    with pytest.raises(UserError, match=r"\.mp4 or \.webm"):
        VideoWriter(tmp_path / name, 20, SIZE)


def test_films_in_a_folder_whose_name_is_not_utf8_are_refused(tmp_path):
    folder = tmp_path / "\udcff"  # OpenCV would end the process
    folder.mkdir()
    with pytest.raises(UserError, match="must be UTF-8"):
        VideoWriter(folder / "film.webm", 20, SIZE)
    with pytest.raises(OSError, match="not UTF-8"):
        read_frames(folder / "film.webm", 1)


def test_video_writer_raises_at_once_when_the_folder_is_missing(tmp_path):
    with pytest.raises(OSError, match="cannot open"):
        VideoWriter(tmp_path / "nowhere" / "film.mp4", 20, SIZE)


def test_video_writer_raises_and_leaves_no_file_when_no_frame_was_written(tmp_path):
    with pytest.raises(OSError, match="no frame"), VideoWriter(tmp_path / "film.mp4", 20, SIZE):
        pass
    assert list(tmp_path.iterdir()) == []


def test_video_writer_raises_when_the_file_lacks_frames(tmp_path):
    with pytest.raises(OSError, match="of 6 frames"), VideoWriter(tmp_path / "film.mp4", 20, SIZE) as film:
        for time in range(5):
            film.write(flat(time))
        film.num_frames += 1
    assert list(tmp_path.iterdir()) == []


def test_video_writer_keeps_the_older_file_when_the_block_fails(tmp_path):
    path = tmp_path / "film.mp4"
    path.write_bytes(b"older")
    with pytest.raises(RuntimeError, match="halfway"), VideoWriter(path, 20, SIZE) as film:
        film.write(flat(0))
        raise RuntimeError("halfway")
    assert path.read_bytes() == b"older"
    assert [entry.name for entry in tmp_path.iterdir()] == ["film.mp4"]


def test_video_writer_accepts_a_colon_in_a_relative_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with VideoWriter("18:30.mp4", 12.5, SIZE) as film:
        film.write(flat(100))
    assert len(read_back(tmp_path / "18:30.mp4")[1]) == 1
