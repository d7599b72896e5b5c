"""`latentplan doctor` reports what the machine offers, and goes on when a check fails."""

import importlib.metadata

from latentplan.commands import doctor
from latentplan.config import UserError


def test_doctor_names_every_part_of_a_working_machine(capsys):
    assert doctor.run(doctor.Request()) == 0
    out = capsys.readouterr().out
    for part in ("torch", "mujoco", "processor", "cuda", "renderer", "frame, exact", "memory", "disk", "video (VP9)"):
        assert part in out
    assert "software" in out or "hardware" in out
    assert "8 of 8 frames read back" in out


def test_versions_name_a_remedy_when_a_package_is_missing_or_bad(monkeypatch, capsys):
    real = importlib.metadata.version

    def version(name):
        if name == "einops":
            raise importlib.metadata.PackageNotFoundError(name)
        return "4.0.1" if name == "mujoco" else real(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    findings = {finding.name: finding for finding in doctor._versions()}
    assert findings["einops"].problem.startswith("pip install 'einops>=")  # within the versions that are allowed
    assert "mujoco<4" in findings["mujoco"].problem
    assert findings["torch"].problem is None


def test_doctor_reports_checks_that_fail_and_goes_on(monkeypatch, capsys):
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
    assert doctor.run(doctor.Request()) == 1
    out = capsys.readouterr().out
    assert "fix: refuse: no OpenGL library found" in out
    assert "OSError: driver gone" in out and "first half" in out
    assert "cannot import latentplan_is_not_called_this" in out
    assert "video (VP9)" in out


def test_kernels_name_a_remedy_when_no_compiler_works(monkeypatch):
    from latentplan.models.fast import library as kernels

    monkeypatch.setattr(kernels, "load", lambda: None)
    (finding,) = doctor._kernels()
    assert finding.value == "torch" and "compiler" in finding.problem and not finding.fatal
