"""The doctor reports what is there, and survives what is missing."""

import importlib.metadata

from latentplan.commands import doctor
from latentplan.config import UserError


def test_a_working_machine_passes_and_every_part_is_named(capsys):
    assert doctor.run_doctor() == 0
    out = capsys.readouterr().out
    for part in ("torch", "mujoco", "processor", "cuda", "renderer", "frame, exact", "memory", "disk", "video (VP9)"):
        assert part in out
    assert "software" in out or "hardware" in out
    assert "8 of 8 frames read back" in out


def test_a_missing_or_bad_package_fails_with_its_remedy(monkeypatch, capsys):
    real = importlib.metadata.version

    def version(name):
        if name == "einops":
            raise importlib.metadata.PackageNotFoundError(name)
        return "4.0.1" if name == "mujoco" else real(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    findings = {finding.name: finding for finding in doctor._versions()}
    assert findings["einops"].problem == "pip install einops"
    assert "mujoco<4" in findings["mujoco"].problem
    assert findings["torch"].problem is None


def test_a_check_that_breaks_becomes_a_line_and_the_rest_goes_on(monkeypatch, capsys):
    def refuse():
        raise UserError("no OpenGL library found to render with; install one")
        yield

    def crash():
        yield doctor.Finding("first half", "fine")
        raise OSError("driver gone")

    def unimportable():
        import latentplan_is_not_called_this  # noqa: F401

        yield

    for name, check in {"_renderer": refuse, "_frame_times": crash, "_device": unimportable}.items():
        monkeypatch.setattr(doctor, name, check)
    assert doctor.run_doctor() == 1
    out = capsys.readouterr().out
    assert "fix: refuse: no OpenGL library found" in out
    assert "OSError: driver gone" in out and "first half" in out
    assert "cannot import latentplan_is_not_called_this" in out
    assert "video (VP9)" in out


def test_a_machine_without_a_compiler_is_told_what_it_lacks(monkeypatch):
    from latentplan.models.fast import library as kernels

    monkeypatch.setattr(kernels, "load", lambda: None)
    (finding,) = doctor._kernels()
    assert finding.value == "torch" and "compiler" in finding.problem and not finding.fatal
