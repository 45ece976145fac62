"""A column of parquet → [rows, width] numbers, whichever of the ways to write it a file has chosen.

What belongs here: lists, scalars, types and missing values. What does not: which columns there should be (frames.py).
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import DatasetError
from pipeline.lerobot_format.files import damage

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

VALUES_AT_A_TIME = 2**19
"""Single values that are decoded at once: 4 MB as int64, whatever the file's row groups are."""


class NotNumbers(ValueError):
    """A column that is no table of numbers; says what it has instead."""


def batches(parquet: "pq.ParquetFile", path: Path, columns: list[str], width: int) -> Iterator["pa.RecordBatch"]:
    """The rows of a file, a few at a time, with these columns, which hold `width` single values a row together.

    Raises:
        DatasetError: the file is damaged.
    """
    import pyarrow as pa

    rows = max(1, VALUES_AT_A_TIME // max(1, width))
    try:
        for batch in parquet.iter_batches(batch_size=rows, columns=columns, use_threads=False):
            if batch.num_rows:
                yield batch.select(columns)
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{path} {damage(error)}") from None


def check_type(kind: "pa.DataType") -> None:
    """What can be known of a column before it is decoded: a few kilobytes of one long word repeated can stand for gigabytes.

    Raises:
        NotNumbers: it holds something that is no number.
    """
    import pyarrow as pa

    while (inner := _inside(kind)) is not None:
        kind = inner
    if not (pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)):
        raise NotNumbers(f"values of type {kind}")


def as_numbers(values: "pa.Array") -> np.ndarray:
    """[rows, width]; a missing number is NaN. `values` has at least one row.

    Raises:
        NotNumbers: lists of different lengths, a row without a value, or something that is no number.
    """
    import pyarrow as pa

    check_type(values.type)
    rows = len(values)
    if isinstance(values, pa.ExtensionArray):
        values = values.storage
    while _is_list(values.type):
        if values.null_count:
            raise NotNumbers("a frame without a value")
        if not pa.types.is_fixed_size_list(values.type):
            lengths = values.value_lengths().unique().to_pylist()
            if len(lengths) > 1:
                raise NotNumbers(f"lists of {min(lengths)} to {max(lengths)}")
        values = values.flatten()
    if pa.types.is_dictionary(values.type):
        values = values.dictionary_decode()
    if pa.types.is_boolean(values.type):
        values = values.cast(pa.uint8())
    return values.to_numpy(zero_copy_only=False).reshape(rows, -1)


def _inside(kind: "pa.DataType") -> "pa.DataType | None":
    """The type of what a list, a dictionary or an extension holds; None for anything else."""
    import pyarrow as pa

    if isinstance(kind, pa.BaseExtensionType):
        return kind.storage_type
    return kind.value_type if _is_list(kind) or pa.types.is_dictionary(kind) else None


def _is_list(kind: "pa.DataType") -> bool:
    import pyarrow as pa

    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
