"""What can still be read of an MCAP file that was cut off, as a whole file again, and how far it goes.

What belongs here: MCAP files of any origin. What does not: writing one (`to_mcap`).
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.errors import StoreError
from pipeline.sinks import replacing
from pipeline.sinks.to_mcap import CHUNK_BYTES, EPISODE, START_STATE

MAGIC = b"\x89MCAP0\r\n"


@dataclass
class Recovered:
    """How many messages there were, and how far they go: seconds into what was under way then."""

    messages: int = 0
    seconds: float = 0.0
    under_way: str = ""
    _began_ns: int | None = field(default=None, repr=False)

    def __str__(self) -> str:
        of = f" of {self.under_way}" if self.under_way else ""
        return f"recovered {self.messages:,} message{'s' * (self.messages != 1)}, up to {self.seconds:.1f} s{of}"

    def count(self, topic: str, message: Any) -> None:
        self.messages += 1
        if topic == EPISODE or topic.endswith(f"/{START_STATE}"):
            self.under_way, self._began_ns = _text(message.data).partition(":")[0], message.log_time
        elif self._began_ns is None:
            self._began_ns = message.log_time
        self.seconds = (message.log_time - self._began_ns) / 1e9


def is_whole(path: Path) -> bool:
    """Whether an MCAP file ends as one does.

    Raises:
        StoreError: it cannot be read, or does not begin as an MCAP file does.
    """
    try:
        with path.open("rb") as file:
            begins = file.read(len(MAGIC)) == MAGIC
            size = file.seek(0, 2)
            file.seek(max(size - len(MAGIC), 0))
            ends = file.read() == MAGIC and size > 2 * len(MAGIC)
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error.strerror}.") from None
    if not begins:
        raise StoreError(
            f"{path} is no MCAP file: it does not begin as one. Name a file that ends in .mcap and was recorded as one."
        )
    return ends


def recover(source: Path, target: Path) -> Recovered:
    """Write what can be read of `source` up to the first damage to `target`, with a new index.

    Raises:
        StoreError: there is not one whole message, or a file cannot be read or written.
    """
    from mcap.writer import Writer

    found = Recovered()
    with source.open("rb") as damaged, replacing(target) as temporary, temporary.open("wb") as file:
        _copy(_readable(damaged), Writer(file, chunk_size=CHUNK_BYTES), found)
        if not found.messages:
            raise StoreError(f"{source} was cut off before its first message: nothing can be recovered. Copy it again.")
    return found


def _readable(file: Any) -> Iterator[Any]:
    """Records up to the first that is not whole."""
    from mcap.exceptions import McapError
    from mcap.stream_reader import StreamReader
    from zstandard import ZstdError

    records = StreamReader(file, validate_crcs=True).records
    while True:
        try:
            record = next(records, None)
        except (McapError, ZstdError, ValueError, struct.error, EOFError):
            return
        if record is None:
            return
        yield record


def _copy(records: Iterator[Any], writer: Any, found: Recovered) -> None:
    """Everything but chunks and indexes, which the writer makes anew."""
    from mcap import records as kinds

    schemas, channels, topics = {0: 0}, {}, {}
    for record in records:
        match record:
            case kinds.Header():
                writer.start(record.profile, record.library)
            case kinds.Schema() if record.id not in schemas:
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            case kinds.Channel() if record.id not in channels:
                topics[record.id], encoding = record.topic, record.message_encoding
                channels[record.id] = writer.register_channel(
                    record.topic, encoding, schemas[record.schema_id], record.metadata
                )
            case kinds.Message():
                found.count(topics[record.channel_id], record)
                times = (record.log_time, record.data, record.publish_time, record.sequence)
                writer.add_message(channels[record.channel_id], *times)
            case kinds.Metadata():
                writer.add_metadata(record.name, record.metadata)
            case kinds.Attachment():
                named = (record.name, record.media_type, record.data)
                writer.add_attachment(record.create_time, record.log_time, *named)
            case kinds.DataEnd():
                break
    if topics:
        writer.finish()


def _text(data: bytes) -> str:
    """What a std_msgs/String says: after four bytes that say how it is encoded, its length with a last zero, then it."""
    length = int.from_bytes(data[4:8], "little")
    return data[8 : 8 + max(length - 1, 0)].decode(errors="replace")
