"""jax's persistent compilation cache: a shape that was compiled by an earlier command is not compiled again.

500 images: 11 entries, 0.5 MB. Entries are never removed by themselves; the folder may be deleted at any time.
"""

import logging
import os
import sys
from pathlib import Path

_log = logging.getLogger(__name__)


def use_compilation_cache() -> None:
    """Switch the cache on for this process, in `$XDG_CACHE_HOME/jaxba` or `~/.cache/jaxba`.

    jax's own environment variables, such as `JAX_COMPILATION_CACHE_DIR`, win. Without a folder that may be written to,
    everything works, only slower.
    """
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
    """Return the user's folder for compiled code (XDG base directories: a relative path counts as none)."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(given) if os.path.isabs(given) else Path(os.path.expanduser("~"), ".cache")) / "jaxba"
