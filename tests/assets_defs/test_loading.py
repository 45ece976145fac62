"""Definitions load fast, and without what only running assets need."""

import json
import subprocess
import sys

import pytest

LOADED = """
import json, sys
from assets_defs.definitions import defs
loaded = defs()
graph = loaded.resolve_asset_graph()
print(json.dumps({"assets": len(list(graph.asset_nodes)), "modules": sorted(sys.modules)}))
"""
HEAVY = ("torch", "mlflow", "rerun", "pandas", "scipy.stats", "pyarrow", "altair", "av", "sklearn")


def test_definitions_load_without_heavy_modules(tmp_path):
    out = subprocess.run([sys.executable, "-c", LOADED], cwd=tmp_path, capture_output=True, text=True, check=True)
    loaded = json.loads(out.stdout)
    assert loaded["assets"] == 6 + 3 * 9 + 5, (
        "the built-in configuration: four baselines, four chunk sizes, one by name"
    )
    assert not set(HEAVY) & set(loaded["modules"])


@pytest.mark.parametrize(
    "method", ["hold_still", "mean_action", "constant_velocity", "nearest_neighbour", "mlp", "notebook_pusht"]
)
def test_every_method_is_where_the_dictionary_says(method):
    from pipeline.methods import METHODS

    cls = METHODS[method].load_class()
    assert all(hasattr(cls, name) for name in ("fit", "predict", "arrays", "settings", "restore"))
