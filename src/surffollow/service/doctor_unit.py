"""Let systemd itself check a unit file (`surffollow doctor --unit`)."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

from surffollow.errors import InputFileError
from surffollow.service.doctor_finding import FAIR, GOOD, LACKING, UNKNOWN, Finding

EXPOSURE_GOOD, EXPOSURE_FAIR = 3.0, 5.0  # of 10, as `systemd-analyze security` counts
SYSTEMD = Path(__file__).parents[1] / "systemd"  # examples, installed with the package
_LIMIT_S = 60.0
_NOT_EXECUTABLE = re.compile(r"^.*Command .* is not executable: .*$\n?", re.MULTILINE)


def _analyze(*words: str) -> tuple[int, str]:
    try:
        done = subprocess.run(
            ["systemd-analyze", "--no-pager", *words], capture_output=True, text=True, timeout=_LIMIT_S
        )
    except (OSError, subprocess.TimeoutExpired) as e:
        return 1, str(e)
    return done.returncode, (done.stdout + done.stderr).strip()


def examine_unit(unit: Path) -> list[Finding]:
    """Result of `systemd-analyze` on a unit file: validity, and sandboxing of the service.

    Raises
    ------
    InputFileError  there is no such file
    """
    if not os.path.isfile(unit):
        raise InputFileError(
            f"there is no unit file {unit}; an example to copy is {SYSTEMD / 'surffollow.service'}"
        )
    valid_why = "systemd ignores what it does not understand, with a line in its journal"
    shut_why = "a fault in the service must not reach what it does not need"
    if shutil.which("systemd-analyze") is None:
        found = "systemd-analyze is not installed here"
        return [Finding(n, UNKNOWN, found, w) for n, w in (("unit", valid_why), ("exposure", shut_why))]
    code, text = _analyze("verify", "--man=no", str(unit))
    absent = "".join(_NOT_EXECUTABLE.findall(text)).strip()
    text = _NOT_EXECUTABLE.sub("", text).strip()
    valid = not text and (code == 0 or bool(absent))
    remedy = "" if valid else "mend the lines named, then: systemctl daemon-reload"
    findings = [Finding("unit", GOOD if valid else LACKING, text or "valid", valid_why, remedy)]
    if absent:
        why = "systemd starts no service whose program is absent or may not be executed"
        remedy = "set the path of ExecStart= (command -v surffollow prints it), then: systemctl daemon-reload"
        findings.append(Finding("executable", LACKING, absent, why, remedy))
    _, text = _analyze("security", "--offline=yes", str(unit))
    level = re.search(r"exposure level for .*?: ([\d.]+)", text)
    if level is None:
        return [*findings, Finding("exposure", UNKNOWN, text[-200:] or "no answer", shut_why)]
    exposure = float(level[1])
    state = GOOD if exposure <= EXPOSURE_GOOD else FAIR if exposure <= EXPOSURE_FAIR else LACKING
    remedy = "" if state == GOOD else f"systemd-analyze security --offline=yes {unit} lists what is open"
    return [*findings, Finding("exposure", state, f"{exposure:g} of 10", shut_why, remedy)]
