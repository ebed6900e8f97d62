"""jax's persistent compilation cache: a shape that was compiled by an earlier command is not compiled again.

Each kind of processor and each jaxlib has a folder of its own, since homes are shared between machines and code that
was compiled for another processor ends the process with an illegal instruction. 500 images: 11 entries, 0.5 MB. Entries
are never removed by themselves; the folder may be deleted at any time.
"""

import functools
import hashlib
import importlib.metadata
import logging
import os
import platform
import sys
import warnings
from pathlib import Path

_log = logging.getLogger(__name__)
_CPUINFO = Path("/proc/cpuinfo")
# what code is compiled for; other lines are of one machine or one moment. The last five are those of ARM
_OF_THE_PROCESSOR = {
    *("vendor_id", "cpu family", "model", "model name", "flags"),
    *("Features", "CPU implementer", "CPU architecture", "CPU variant", "CPU part"),
}


def use_compilation_cache() -> None:
    """Switch the cache on for this process, in this machine's folder of `$XDG_CACHE_HOME/jaxba` or `~/.cache/jaxba`.

    jax's own environment variables, such as `JAX_COMPILATION_CACHE_DIR`, win. Without a folder that may be written to,
    everything works, only slower. An entry that another process is writing just now, or was killed over, cannot be
    read: jax compiles anew then, and would warn of it.
    """
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry", UserWarning)
    settings = {
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = cache_folder()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            _log.info("compiled code is not kept: %s", error)
            return
        if not os.access(folder, os.W_OK | os.X_OK):
            _log.info("compiled code is not kept: %s may not be written to", folder)
            return
        settings["jax_compilation_cache_dir"] = str(folder)
    for name, value in settings.items():
        if name.upper() in os.environ:
            continue
        os.environ[name.upper()] = str(value)  # for a jax that is loaded later, if at all
        if "jax" in sys.modules:
            sys.modules["jax"].config.update(name, value)


def cache_folder() -> Path:
    """Return the user's folder for code compiled on such a machine (XDG: a relative path counts as none)."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    caches = Path(given) if os.path.isabs(given) else Path(os.path.expanduser("~"), ".cache")
    return caches / "jaxba" / folder_name()


@functools.cache
def folder_name() -> str:
    """Return the name that all machines share which can run each other's compiled code: processor and jaxlib.

    >>> folder_name()  # doctest: +SKIP
    'x86_64-1a2b3c4d-jaxlib-0.10.2'
    """
    digest = hashlib.sha256(_processor().encode()).hexdigest()[:8]
    machine = platform.machine() or "unknown"
    return f"{machine}-{digest}-jaxlib-{importlib.metadata.version('jaxlib')}"


def _processor() -> str:
    """Return the model of the processor and what it can do."""
    found = {}
    try:
        with open(_CPUINFO, encoding="utf-8", errors="replace") as file:
            for line in file:
                if not line.strip() and found:  # the first core's: later ones repeat it
                    break
                name, _, value = line.partition(":")
                if name.strip() in _OF_THE_PROCESSOR:
                    found[name.strip()] = " ".join(sorted(value.split()))
    except OSError:
        pass
    return "\n".join(f"{name}: {value}" for name, value in sorted(found.items())) or platform.processor()
