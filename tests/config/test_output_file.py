"""Files to be written are checked before any work is spent on their content."""

import os

import pytest

from latentplan.config import UserError, output_file


def test_output_file_returns_the_path_and_leaves_nothing(tmp_path):
    assert output_file(tmp_path / "result.json", "--json") == tmp_path / "result.json"
    assert not list(tmp_path.iterdir())


def test_output_file_returns_the_target_of_a_link(tmp_path):
    (tmp_path / "link.json").symlink_to("target.json")
    assert output_file(tmp_path / "link.json", "--json") == tmp_path / "target.json"


@pytest.mark.parametrize("target", ["link.json", "no/where.json"])
def test_output_file_refuses_links_that_lead_nowhere(tmp_path, target):
    (tmp_path / "link.json").symlink_to(target)
    with pytest.raises(UserError, match="--json .*link.json' is a link that leads nowhere"):
        output_file(tmp_path / "link.json", "--json")


def test_output_file_refuses_pipes(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match="is not a regular file"):
        output_file(tmp_path / "pipe", "--json")
    assert (tmp_path / "pipe").is_fifo()
