"""From photos to a georeferenced cloud: one module a stage, wired by `_stages.py` and run by `_runner.py`.

`import jaxba.pipeline` loads nothing else: a worker that runs one stage loads that stage alone (PEP 562).
"""

from typing import TYPE_CHECKING

from jaxba._lazy import lazy

if TYPE_CHECKING:
    from jaxba.pipeline._events import Event, Run
    from jaxba.pipeline._runner import run_pipeline
    from jaxba.pipeline._settings import Settings, changed, default_settings, explained, from_toml, to_toml
    from jaxba.pipeline._stages import NAMES, STAGES
    from jaxba.pipeline._status import Status, project_settings, status
    from jaxba.pipeline._summary import stage_lines, summary
    from jaxba.pipeline._workers import Resources

__all__ = [
    "NAMES", "STAGES", "Event", "Resources", "Run", "Settings", "Status", "changed", "default_settings", "explained",
    "from_toml", "project_settings", "run_pipeline", "stage_lines", "status", "summary", "to_toml",
]  # fmt: skip

_MODULE_OF = {
    "NAMES": "jaxba.pipeline._stages",
    "STAGES": "jaxba.pipeline._stages",
    "Event": "jaxba.pipeline._events",
    "Resources": "jaxba.pipeline._workers",
    "Run": "jaxba.pipeline._events",
    "Settings": "jaxba.pipeline._settings",
    "Status": "jaxba.pipeline._status",
    "changed": "jaxba.pipeline._settings",
    "default_settings": "jaxba.pipeline._settings",
    "explained": "jaxba.pipeline._settings",
    "from_toml": "jaxba.pipeline._settings",
    "project_settings": "jaxba.pipeline._status",
    "run_pipeline": "jaxba.pipeline._runner",
    "stage_lines": "jaxba.pipeline._summary",
    "status": "jaxba.pipeline._status",
    "summary": "jaxba.pipeline._summary",
    "to_toml": "jaxba.pipeline._settings",
}

__getattr__, __dir__ = lazy(__name__, _MODULE_OF)
