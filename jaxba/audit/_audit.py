"""An audit on one screen: read the model, hold its claims against its numbers, adjust it anew, tell what is wrong."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxba._atomic import cannot_write
from jaxba._errors import JaxbaError
from jaxba.audit._claims import check_claims
from jaxba.audit._faults import findings, is_fault
from jaxba.audit._moved import moved_images, moved_intrinsics
from jaxba.audit._readjust import readjust
from jaxba.audit._report import report_facts
from jaxba.audit._section import section
from jaxba.engine._project import read_list
from jaxba.io import read_reconstruction
from jaxba.pipeline import PIPELINE
from jaxba.report.document import write_facts
from jaxba.scene import Finding


@dataclass(frozen=True, kw_only=True, eq=False)
class Audited:
    """What an audit found.

    - `facts`: of the report, its section `audit` among them. `findings`: all, the faults first. `page`: the report.
    """

    facts: dict[str, Any]
    findings: tuple[Finding, ...]
    page: Path

    @property
    def faults(self) -> tuple[Finding, ...]:
        """Findings that say that something is wrong with the model, its claims or its control."""
        return tuple(finding for finding in self.findings if is_fault(finding))


def audit(model: Path, out: Path, *, gcp: Path | None = None, crs: str | None = None) -> Audited:
    """Audit another program's result, and write the report into a folder, which is made.

    - `model`: a COLMAP model's folder, an OpenSfM reconstruction's folder or file, a BAL problem or a tile.
    - `gcp`: a list of control points, as `jaxba run --gcp` takes it; its marks name images of the model. `crs`: of the
      results, and of a list that names none.

    Raises:
        JaxbaError: the model or the list cannot be read or contradict themselves, too little of the model can be
            adjusted, or a file cannot be written.
    """
    if out.exists() and not out.is_dir():
        raise JaxbaError(f"{out}: is a file, where the folder of the report is to be; name another as --out.")
    given = read_reconstruction(model)
    control = read_list(gcp, "a gcp_list.txt or CSV")
    claims = check_claims(given)
    found = readjust(given, control, crs)
    images, intrinsics = moved_images(found), moved_intrinsics(found)
    settings: Any = PIPELINE.settings["adjust"]
    every = findings(given, claims, found, images, intrinsics, settings.min_angle)
    of_audit = section(model, given, claims, found, images, intrinsics, every, settings.min_angle)
    facts = report_facts(out, model, given, found, every, of_audit)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(out, error) from error
    return Audited(facts=facts, findings=every, page=write_facts(out, facts))
