"""Reports known vulnerabilities of the installed packages: `python scripts/audit.py`.

pip-audit asks the package index about every package but this project itself, which is installed from its own folder.
Where the index cannot be reached, or does not know a package, the script says what was not checked, and succeeds. It
fails where a package has a known vulnerability, and where pip-audit is not installed.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from typing import Any

COMMAND = ("-m", "pip_audit", "--local", "--skip-editable", "--progress-spinner", "off", "--format", "json")
EDITABLE = "distribution marked as editable"  # the reason of pip-audit to skip this project itself
TIMEOUT_S = 600


def main() -> int:
    """Prints the outcome and returns the exit code: 1 for a known vulnerability, or without pip-audit."""
    if importlib.util.find_spec("pip_audit") is None:
        print("audit: not done, because pip-audit is not installed: pip install pip-audit")
        return 1
    try:
        done = subprocess.run(
            [sys.executable, *COMMAND], capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
        report = json.loads(done.stdout)
    except subprocess.TimeoutExpired:
        report, reason = None, f"no answer within {TIMEOUT_S} s"
    except ValueError:
        reason = (done.stderr.strip().splitlines() or ["pip-audit printed nothing"])[-1][:200]
        report = None
    if report is None:
        print(f"audit: not done, because the package index cannot be asked ({reason})")
        return 0
    lines, code = describe(report)
    print("\n".join(lines))
    return code


def describe(report: dict[str, Any]) -> tuple[list[str], int]:
    """Lines about a report of pip-audit, and the exit code.

    Args:
        report: The report, as pip-audit writes it in JSON.
    """
    packages = [package for package in report["dependencies"] if package.get("skip_reason") != EDITABLE]
    known = [package for package in packages if "skip_reason" not in package]
    lines = [
        f"audit: {package['name']} {package['version']} has {found['id']}; "
        f"fixed in {', '.join(found.get('fix_versions') or []) or 'no version yet'}"
        for package in known
        for found in package["vulns"]
    ]
    unknown = len(packages) - len(known)
    if unknown:
        lines.append(f"audit: {unknown} of {len(packages)} packages not checked, because the index does not know them")
    if known:
        affected = sum(bool(package["vulns"]) for package in known)
        lines.append(f"audit: {len(known)} packages checked, {affected} with a known vulnerability")
    return lines, int(any(package["vulns"] for package in known))


if __name__ == "__main__":
    sys.exit(main())
