"""Process-wide settings."""

import sys

import pytest

from tests.processes import run_script

ALLOCATES = """
import resource
from mjx_study.runtime import configure

configure(cpu_devices=1)
faults = []
for _ in range(3):
    block = bytearray(b"x") * (100 << 20)
    del block
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
print(faults[2] - faults[1])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="a setting of glibc's")
def test_memory_that_is_freed_and_needed_again_is_not_cleared_again() -> None:
    assert int(run_script(ALLOCATES).stdout) < 1000, "of 25,600 pages"
