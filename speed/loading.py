"""Loading the definitions, against `import dagster` alone: whole processes, CPU time."""

import os
import subprocess
import sys

DAGSTER = "import dagster"
DEFINITIONS = "from assets_defs.definitions import defs; defs()"
PAIRS = 5


def cpu_s(code: str) -> float:
    """CPU seconds of a Python process that runs the code."""
    before = os.times()
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def measure() -> list[str]:
    pairs = sorted(cpu_s(DEFINITIONS) / cpu_s(DAGSTER) for _ in range(PAIRS))
    return [
        f"definitions load in {pairs[PAIRS // 2]:.2f} times the CPU time of `import dagster` "
        f"({pairs[0]:.2f} to {pairs[-1]:.2f})"
    ]
