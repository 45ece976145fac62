"""Files are cut off at every kind of place; what is recovered must be what the whole file begins with."""

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from pipeline.errors import StoreError
from pipeline.sinks.mcap_recovery import is_whole, recover
from pipeline.sinks.to_mcap import GAP_S, METADATA, write_mcap

from .making import make_demos, make_predictions, make_semantics


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """Some chunks' worth: three episodes of 300 frames."""
    demos = make_demos(columns=6, lengths=(300, 300, 300))
    path = tmp_path_factory.mktemp("mcap") / "whole.mcap"
    predictions = [make_predictions(demos, [0, 1, 2])]
    held = {"split.json": {"folds": []}}
    write_mcap(path, demos, make_semantics(demos), predictions, [0, 1, 2], metadata={}, attachments=held)
    return path


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as file:
        return [(channel.topic, m.log_time, m.data) for _, channel, m in make_reader(file).iter_messages()]


@pytest.mark.parametrize("share", [0.4, 0.7, 0.95])
def test_what_is_recovered_is_what_the_whole_file_begins_with(tmp_path, whole, share):
    cut, target = tmp_path / "cut.mcap", tmp_path / "recovered.mcap"
    data = whole.read_bytes()
    cut.write_bytes(data[: int(share * len(data))])
    assert (is_whole(whole), is_whole(cut)) == (True, False)
    found = recover(cut, target)
    assert is_whole(target)
    kept, all_of_them = messages(target), messages(whole)
    assert kept == all_of_them[: found.messages]
    time_ns = kept[-1][1]
    with whole.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    before = [c for c in chunks if c.chunk_start_offset + c.chunk_length <= int(share * len(data))]
    assert len(before) > 0
    assert time_ns == before[-1].message_end_time, "every chunk that is whole was kept"
    number = sum(topic == "/episode" for topic, _, _ in kept)
    assert found.under_way == f"episode {6 + number}"
    began = GAP_S + (number - 1) * (29.9 + GAP_S)
    np.testing.assert_allclose(found.seconds, time_ns / 1e9 - began, atol=1e-6)
    assert str(found) == f"recovered {len(kept):,} messages, up to {found.seconds:.1f} s of episode {6 + number}"
    with target.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        assert reader.get_summary().statistics.message_count == found.messages
        assert [one.name for one in reader.iter_metadata()] == [METADATA]
        assert [one.name for one in reader.iter_attachments()] == ["split.json"]


def test_only_the_index_is_missing(tmp_path, whole):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-20])
    assert recover(cut, tmp_path / "r.mcap").messages == len(messages(whole))


def test_a_damaged_chunk_ends_what_is_recovered(tmp_path, whole):
    data = bytearray(whole.read_bytes())
    with whole.open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[2]
    data[chunk.chunk_start_offset + 200] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data[:-20])
    found = recover(damaged, tmp_path / "r.mcap")
    assert 0 < found.messages < len(messages(whole))
    assert messages(tmp_path / "r.mcap") == messages(whole)[: found.messages]


def test_a_file_of_others_without_episodes(tmp_path):
    from mcap.writer import Writer

    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=64)
        writer.start()
        channel = writer.register_channel("/x", "json", writer.register_schema("x", "jsonschema", b"{}"))
        for k in range(20):
            writer.add_message(channel, 10**9 + k * 10**8, b"{}" * 20, 10**9 + k * 10**8)
        writer.finish()
    path.write_bytes(path.read_bytes()[:-10])
    assert str(recover(path, tmp_path / "r.mcap")) == "recovered 20 messages, up to 1.9 s"


@pytest.mark.parametrize("kept", [20, 400])
def test_nothing_to_recover_is_said_and_leaves_no_file(tmp_path, whole, kept):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:kept])
    with pytest.raises(StoreError, match="cut off before its first message"):
        recover(cut, tmp_path / "r.mcap")
    assert list(tmp_path.iterdir()) == [cut]


def test_what_is_no_mcap_is_said(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"not one")
    with pytest.raises(StoreError, match=r"a\.mcap is no MCAP file"):
        is_whole(tmp_path / "a.mcap")
    with pytest.raises(StoreError, match=r"none\.mcap cannot be read: No such file"):
        is_whole(tmp_path / "none.mcap")
