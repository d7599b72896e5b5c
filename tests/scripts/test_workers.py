"""Jobs of a benchmark in processes of their own: their order, and what ends them."""

import time
from functools import partial

import pytest
from bench.workers import run_in_order


def work(folder, number):
    """Fails at job 0; every other job leaves a file and takes a second."""
    if number == 0:
        raise ValueError("job 0 fails")
    (folder / str(number)).touch()
    time.sleep(1.0)
    return number


def test_results_come_in_the_order_of_the_jobs(tmp_path):
    assert list(run_in_order(partial(work, tmp_path), [2, 1], 2)) == [2, 1]


def test_no_job_begins_after_one_has_failed(tmp_path):
    with pytest.raises(ValueError, match="job 0 fails"):
        list(run_in_order(partial(work, tmp_path), range(9), 2))
    time.sleep(2.0)  # jobs that were given up would have ended, and others begun
    assert len(list(tmp_path.iterdir())) <= 4  # of two processes, each with a job and one that waits


def test_no_job_begins_after_its_results_are_no_longer_read(tmp_path):
    results = run_in_order(partial(work, tmp_path), range(1, 9), 2)
    assert next(results) == 1
    results.close()
    time.sleep(2.0)
    assert len(list(tmp_path.iterdir())) <= 6
