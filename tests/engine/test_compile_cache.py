import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from jaxba.engine import _compile_cache
from jaxba.engine._compile_cache import folder_name

CORE = """processor\t: {core}
vendor_id\t: GenuineIntel
model name\t: Some processor
microcode\t: {microcode}
cpu MHz\t\t: {mhz}
flags\t\t: {flags}

"""


@pytest.fixture
def named_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The folder's name on a machine that describes its processor by a text."""

    def name(text: str | None) -> str:
        path = tmp_path / "cpuinfo"
        path.unlink(missing_ok=True)
        if text is not None:
            path.write_text(text)
        monkeypatch.setattr(_compile_cache, "_CPUINFO", path)
        folder_name.cache_clear()
        return folder_name()

    yield name
    folder_name.cache_clear()


def machine(flags: str, microcode: str = "0x1", mhz: float = 2300.0) -> str:
    return "".join(CORE.format(core=core, microcode=microcode, mhz=mhz + core, flags=flags) for core in range(2))


def test_folder_is_named_by_processor_and_jaxlib():
    assert re.fullmatch(r"\w+-[0-9a-f]{8}-jaxlib-[\w.]+", folder_name())


def test_machines_with_the_same_processor_share_a_folder_and_others_do_not(named_on):
    one = named_on(machine("fpu sse2 avx2"))
    assert one == named_on(machine("sse2 avx2 fpu", microcode="0x2", mhz=1800.0))
    assert one != named_on(machine("fpu sse2 avx2 avx512f"))
    assert one != named_on(machine("fpu sse2 avx2").replace("Some", "Another"))


def test_arm_is_told_apart_by_its_features(named_on):
    arm = "processor\t: 0\nBogoMIPS\t: 50\nFeatures\t: fp asimd\nCPU part\t: 0xd0c\n\n"
    assert named_on(arm) == named_on(arm.replace("50", "60")) != named_on(arm.replace("asimd", "asimd sve"))


def test_without_a_description_the_platforms_word_counts(named_on, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(_compile_cache.platform, "processor", lambda: "arm")
    one = named_on(None)
    monkeypatch.setattr(_compile_cache.platform, "processor", lambda: "i386")
    assert one != named_on(None)


def test_naming_the_folder_loads_no_jax():
    code = (
        "import sys\nfrom jaxba.engine._compile_cache import folder_name\nfolder_name()\n"
        "print(*sorted({'jax', 'jaxlib', 'numpy'} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == []


_COMPILE = """
from jaxba.engine._compile_cache import use_compilation_cache
use_compilation_cache()
import jax
print(float(jax.jit(lambda x: 2 * x + 1)(3.0)))
"""


def test_an_entry_that_was_cut_off_is_compiled_anew_without_a_word(tmp_path: Path):
    """As a process leaves it that is killed while it writes, or that is still writing."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    env["XDG_CACHE_HOME"] = str(tmp_path)
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", _COMPILE], env=env, capture_output=True, text=True)
        assert (done.stdout, done.stderr) == ("7.0\n", "")
        entries = list(tmp_path.rglob("*-cache"))
        assert entries
        for entry in entries:
            entry.write_bytes(entry.read_bytes()[:-20])
