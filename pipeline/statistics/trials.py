"""Trials of policies on a real robot, from a CSV file: one row a trial.

What belongs here: reading the file and saying what is wrong with it. What does not: rates, intervals and tests
(`success`).
"""

import csv
import io
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import DatasetError, did_you_mean

HEADERS = {
    "policy": ("policy", "policy name", "method", "checkpoint", "model"),
    "start state": ("start state", "start", "state", "initial state", "start position"),
    "success": ("success", "succeeded", "successful", "ok"),
    "stage": ("stage", "progress stage", "progress"),
}
"""What each column may be called, whatever the capitals; `_` and `-` count as spaces."""
REQUIRED = ("policy", "start state", "success")
WORDS = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}
EXAMPLE = "policy,start_state,success"
DELIMITERS = (",", ";", "\t")
LARGEST = 50_000_000
"""Bytes; a file of trials that is larger is some other file."""


@dataclass(frozen=True)
class Trials:
    """R trials in the order of the file.

    policy [R], start [R] names       success [R] bool
    stage  [R] how far each trial came, or None where the file has no such column: float64 where every stage is a
           number (a trial that reached stage 3 reached 1 and 2), else names
    """

    policy: np.ndarray
    start: np.ndarray
    success: np.ndarray
    stage: np.ndarray | None

    @property
    def policies(self) -> tuple[str, ...]:
        """In the order in which they first appear."""
        return tuple(dict.fromkeys(self.policy.tolist()))


def read_trials(path: Path) -> Trials:
    """Read a CSV file with the columns policy, start state, success and, if there is one, stage.

    Comma, semicolon or tab; with or without a byte order mark; quoted fields; empty lines and other columns are passed
    over.

    Raises
    ------
    DatasetError : the file cannot be read, a column is missing, a value means nothing, or a policy was tried once. The
        message has the line, what was found and what was expected.
    """
    rows = _rows(_text(path), path)
    try:
        line, header = next(rows)
    except StopIteration:
        raise DatasetError(f"{path} is empty. Expected a header line: {EXAMPLE}.") from None
    columns = _columns(header, line, path)
    cells = [_cells(row, number, header, columns, path) for number, row in rows]
    if not cells:
        raise DatasetError(f"{path} has a header in line {line} and no trials below it. Expected one row a trial.")
    _check_tried_twice([(number, found["policy"]) for number, found in cells], path)
    success = [_success(found["success"], number, path) for number, found in cells]
    stage = _stages([found["stage"] for _, found in cells]) if "stage" in columns else None
    return Trials(
        np.array([found["policy"] for _, found in cells]),
        np.array([found["start state"] for _, found in cells]),
        np.array(success),
        stage,
    )


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > LARGEST:
            raise DatasetError(f"{path} is larger than {LARGEST // 10**6} MB. Expected a CSV file, one row a trial.")
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DatasetError(
            f"{path} is not UTF-8 text (byte {error.start} is 0x{error.object[error.start]:02x}). Save it as 'CSV UTF-8'."
        ) from None
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}. Expected a CSV file, one row a trial.") from None


def _rows(text: str, path: Path) -> Iterator[tuple[int, list[str]]]:
    """(line, fields) of every line that is not empty, cut where the header is cut."""
    first = next((line for line in text.splitlines() if line.strip()), "")
    delimiter = max(DELIMITERS, key=lambda sign: len(_known(next(csv.reader([first], delimiter=sign), []))))
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    try:
        for row in reader:
            fields = [field.strip() for field in row]
            if any(fields):
                yield reader.line_num, fields
    except csv.Error as error:
        found = f"{path}, line {reader.line_num}: the quoting is broken ({error})."
        raise DatasetError(f'{found} Expected quotes in pairs, as in "red, left"') from None


def _known(header: Sequence[str]) -> dict[str, int]:
    """The columns that the header has, and where."""
    plain = [re.sub(r"[\s_-]+", " ", field).strip().lower() for field in header]
    return {name: plain.index(word) for name, words in HEADERS.items() for word in reversed(words) if word in plain}


def _columns(header: Sequence[str], line: int, path: Path) -> dict[str, int]:
    columns = _known(header)
    missing = [name for name in REQUIRED if name not in columns]
    if missing:
        raise DatasetError(
            f"{path}, line {line}: no column for {' and '.join(missing)} in '{' | '.join(header)[:200]}'. Expected a "
            f"header such as '{EXAMPLE}', separated by comma, semicolon or tab. Without start states, give counts "
            "instead: demobench success 18/20 16/20"
        )
    return columns


def _cells(
    row: Sequence[str], line: int, header: Sequence[str], columns: dict[str, int], path: Path
) -> tuple[int, dict[str, str]]:
    if len(row) != len(header):
        raise DatasetError(
            f"{path}, line {line}: {len(row)} fields, expected {len(header)} as in the header. Put a field that contains "
            "the separator in double quotes."
        )
    found = {name: row[column] for name, column in columns.items()}
    for name, value in found.items():
        if not value:
            remedy = " Write how far every trial came, or leave the column out." if name == "stage" else ""
            raise DatasetError(
                f"{path}, line {line}: nothing under '{header[columns[name]]}'. Expected a value.{remedy}"
            )
    return line, found


def _success(word: str, line: int, path: Path) -> bool:
    plain = word.lower().removesuffix(".0")
    if plain not in WORDS:
        raise DatasetError(f"{path}, line {line}: success is '{word}'. Expected one of {', '.join(WORDS)}.")
    return WORDS[plain]


def _check_tried_twice(policies: Sequence[tuple[int, str]], path: Path) -> None:
    """A policy tried once is a slip of the pen more often than an experiment."""
    tried = Counter(policy for _, policy in policies)
    for line, policy in policies:
        if tried[policy] == 1:
            others = [name for name in tried if name != policy]
            raise DatasetError(
                f"{path}, line {line}: the policy '{policy}' was tried once in the whole file. Expected at least 2 trials "
                f"of each policy. {did_you_mean(policy, others)}".rstrip()
            )


def _stages(stages: Sequence[str]) -> np.ndarray:
    try:
        numbers = np.array([float(stage) for stage in stages])
    except ValueError:
        return np.array(stages)
    return numbers if np.isfinite(numbers).all() else np.array(stages)
