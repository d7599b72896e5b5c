"""Outputs are refused before any work is spent on them where they cannot go."""

import os

import pytest

from latentplan.config import UserError, output_file


def test_a_file_beside_others_is_where_it_goes(tmp_path):
    assert output_file(tmp_path / "result.json", "--json") == tmp_path / "result.json"
    assert not list(tmp_path.iterdir())


def test_a_link_leads_to_where_it_goes(tmp_path):
    (tmp_path / "link.json").symlink_to("target.json")
    assert output_file(tmp_path / "link.json", "--json") == tmp_path / "target.json"


@pytest.mark.parametrize("target", ["link.json", "no/where.json"])
def test_a_link_that_leads_nowhere_is_refused(tmp_path, target):
    (tmp_path / "link.json").symlink_to(target)
    with pytest.raises(UserError, match="--json .*link.json' is a link that leads nowhere"):
        output_file(tmp_path / "link.json", "--json")


def test_what_is_no_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match="is not a file"):
        output_file(tmp_path / "pipe", "--json")
    assert (tmp_path / "pipe").is_fifo()
