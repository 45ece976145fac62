"""The wheel in a clean environment, used in an empty folder: nothing may lean on the checkout."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

ROOT = Path(__file__).resolve().parents[1]


def run(*words, cwd: Path, **environment: str) -> subprocess.CompletedProcess:
    inherited = {
        k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV", "DEMOBENCH", "DAGSTER"))
    }
    out = subprocess.run(
        [*map(str, words)], cwd=cwd, env={**inherited, **environment}, capture_output=True, text=True, check=False
    )
    assert out.returncode == 0, out.stdout[-2000:] + out.stderr[-2000:]
    return out


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """The `bin` folder of an environment that has the wheel and what it needs, at the pinned versions."""
    place = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "build", "--wheel", "--outdir", place, ROOT, cwd=place)
    (wheel,) = place.glob("demobench-*.whl")
    run(sys.executable, "-m", "venv", place / "venv", cwd=place)
    pip = [place / "venv/bin/python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    run(*pip, "-c", ROOT / "constraints.txt", wheel, cwd=place)
    return place / "venv" / "bin"


def test_it_inspects_and_benchmarks_in_an_empty_folder(installed, tmp_path):
    for name, least in (("pusht_sim", 150), ("so101_sim", 50)):
        facts = json.loads(run(installed / "demobench", "inspect", name, "--json", "-", cwd=tmp_path).stdout)
        assert facts["episodes"] >= least
    words = ["run", "pusht_sim", "--policies", "mlp", "--chunks", "1", "--steps", "20", "--seeds", "1", "--json", "-"]
    out = run(installed / "demobench", *words, cwd=tmp_path, NO_COLOR="1")
    (found,) = json.loads(out.stdout)
    assert {"hold_still", "mlp_k01"} <= {row["policy"] for row in found["policies"]}
    assert all(row["rollouts"] is None for row in found["policies"]), (
        "the simulator is an extra, and it is not installed"
    )
    assert Path(found["artifacts"]["report"]).stat().st_size > 100_000
    assert Path(found["artifacts"]["report"]).is_relative_to(tmp_path)
