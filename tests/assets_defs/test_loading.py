"""Definitions load fast, and without what only running assets need."""

import json
import subprocess
import sys

import pytest

from pipeline.methods import METHODS

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
    assert loaded["assets"] == 6 + 3 * 10 + 6, (
        "the built-in configuration: four baselines, four chunk sizes, a recipe, one by name"
    )
    assert not set(HEAVY) & set(loaded["modules"])


@pytest.mark.parametrize("method", METHODS)
def test_every_method_is_where_the_dictionary_says(method):
    cls = METHODS[method].load_class()
    assert all(hasattr(cls, name) for name in ("fit", "predict", "arrays", "settings", "restore"))
