"""Where links point: to the ports that `demobench ui` used last, else to its default ones."""

import pytest

from assets_defs.links import Served, remember_served, served
from pipeline.store import Store


def test_links_point_where_the_store_was_served_last(tmp_path):
    store = Store(tmp_path)
    assert served(store) == Served("http://127.0.0.1:3001", "http://127.0.0.1:5000")
    remember_served(store, Served("http://127.0.0.1:4001", "http://127.0.0.1:4002"))
    assert served(store) == Served("http://127.0.0.1:4001", "http://127.0.0.1:4002")


@pytest.mark.parametrize("damage", ["", "{", "[]", '{"files": "http://127.0.0.1:1"}'])
def test_a_damaged_note_is_no_obstacle(tmp_path, damage):
    store = Store(tmp_path)
    remember_served(store, Served())
    (tmp_path / "dagster" / "served.json").write_text(damage)
    assert served(store) == Served()
