"""The audit fails for a known vulnerability alone, and says where nothing could be checked."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.fixture
def audit(root, monkeypatch):
    monkeypatch.syspath_prepend(str(root / "scripts"))
    import audit

    return audit


def test_describe_fails_for_a_known_vulnerability(audit):
    found = [{"id": "CVE-1", "fix_versions": ["2.0"]}, {"id": "CVE-2", "fix_versions": []}]
    report = {
        "dependencies": [{"name": "a", "version": "1.0", "vulns": found}, {"name": "b", "version": "1", "vulns": []}]
    }
    lines, code = audit.describe(report)
    assert code == 1 and lines == [
        "audit: a 1.0 has CVE-1; fixed in 2.0",
        "audit: a 1.0 has CVE-2; fixed in no version yet",
        "audit: 2 packages checked, 1 with a known vulnerability",
    ]


def test_describe_says_how_many_packages_the_index_does_not_know(audit):
    report = {"dependencies": [{"name": "a", "skip_reason": "not found"}, {"name": "b", "version": "1", "vulns": []}]}
    lines, code = audit.describe(report)
    assert code == 0 and lines[0] == "audit: 1 of 2 packages not checked, because the index does not know them"


def test_describe_leaves_out_the_editable_install_of_the_project_itself(audit):
    own = {"name": "latentplan", "skip_reason": audit.EDITABLE}
    lines, code = audit.describe({"dependencies": [own, {"name": "b", "version": "1", "vulns": []}]})
    assert code == 0 and lines == ["audit: 1 packages checked, 0 with a known vulnerability"]


def test_describe_names_the_editable_install_as_pip_audit_does(audit):
    source = importlib.util.find_spec("pip_audit._dependency_source.pip")
    assert f'"{audit.EDITABLE}"' in Path(source.origin).read_text()


def test_main_fails_where_pip_audit_is_missing(audit, monkeypatch, capsys):
    monkeypatch.setattr(audit.importlib.util, "find_spec", lambda name: None)
    assert audit.main() == 1
    assert capsys.readouterr().out == "audit: not done, because pip-audit is not installed: pip install pip-audit\n"


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (subprocess.CompletedProcess([], 1, "", "trace\nConnectionError: no route to host"), "no route to host"),
        (subprocess.CompletedProcess([], 1, "", ""), "printed nothing"),
        (subprocess.TimeoutExpired([], 600), "no answer within 600 s"),
    ],
)
def test_main_says_that_the_index_cannot_be_asked_and_succeeds(answer, words, audit, monkeypatch, capsys):
    def run(command, **_):
        assert command[0] == sys.executable
        if isinstance(answer, Exception):
            raise answer
        return answer

    monkeypatch.setattr(audit.subprocess, "run", run)
    assert audit.main() == 0
    printed = capsys.readouterr().out
    assert printed.startswith("audit: not done") and words in printed and printed.count("\n") == 1
