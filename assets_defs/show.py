"""Small helpers that turn results into Dagster metadata: markdown tables and pictures inside markdown."""

import base64
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import dagster as dg


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A GitHub-style table. Cells from a data set cannot break out of it."""

    def line(cells: Iterable[Any]) -> str:
        return "| " + " | ".join(_cell(c) for c in cells) + " |"

    return "\n".join([line(header), "|" + "---|" * len(header), *(line(row) for row in rows)])


def _cell(value: Any) -> str:
    if value is None:
        return "—"
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> dg.MarkdownMetadataValue:
    return dg.MetadataValue.md(markdown_table(header, rows))


def picture(path: Path) -> dg.MarkdownMetadataValue | None:
    """A PNG as markdown, which the UI shows without fetching anything. None where the file is not there."""
    if not path.exists():
        return None
    return dg.MetadataValue.md(f"![{path.stem}](data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()})")


def present(metadata: dict[str, Any]) -> dict[str, Any]:
    """Metadata without the entries that have no value."""
    return {name: value for name, value in metadata.items() if value is not None}


def interval_words(interval: Sequence[float] | None) -> str | None:
    """An interval as a table's cell."""
    return f"{interval[0]:.4g} … {interval[1]:.4g}" if interval else None
