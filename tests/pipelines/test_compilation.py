"""Machine code of earlier processes is loaded without a call."""

import subprocess
import sys

MODULE = """
from spheremark.pipelines.compilation import compiled

@compiled
def doubled(x):
    return 2.0 * x
"""
LOAD = """
from spheremark.pipelines.compilation import load_kernels
import kernel_of_a_test as module
n = load_kernels("kernel_of_a_test")
print(n, len(module.doubled.signatures), sum(module.doubled.stats.cache_misses.values()))
"""


def test_kernels_are_loaded_from_disk_and_not_compiled_again(tmp_path):
    (tmp_path / "kernel_of_a_test.py").write_text(MODULE)

    def run(code):
        command = [sys.executable, "-c", code]
        return subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=120
        ).stdout.split()

    assert run(LOAD) == ["0", "0", "0"]
    run("import kernel_of_a_test as module; module.doubled(1.5)")
    assert run(LOAD) == ["1", "1", "0"]
