"""Tables of how a result came about: stages, parameters, versions, and the hashes of files."""

from typing import Any

from jaxba.report.page._tables import Column, Table, number, table, text

Rows = list[dict[str, Any]]


def stage_table(stages: Rows) -> Table:
    """Return the stages with their times and what they said."""
    rows = [[stage["name"], number(stage["seconds"], 1), "\n".join(stage["lines"])] for stage in stages]
    return table("Stages", [text("stage"), Column(name="time", unit="s"), text("what it said")], rows)


def parameter_table(parameters: Rows) -> Table:
    """Return every parameter, those that were changed first."""
    ordered = sorted(parameters, key=lambda row: not row["changed"])
    rows = [[row["section"], row["name"], row["value"], row["default"], row["changed"]] for row in ordered]
    changed = sum(row["changed"] for row in parameters)
    columns = [text(name) for name in ("section", "parameter", "value", "default", "changed")]
    return table(f"Parameters ({len(rows):,}, of which {changed:,} changed)", columns, rows, is_closed=True)


def version_table(versions: Rows) -> Table:
    """Return the software with its versions."""
    columns = [text("software"), text("version")]
    return table("Versions", columns, [[row["name"], row["version"]] for row in versions], is_closed=True)


def hash_table(title: str, files: Rows) -> Table:
    """Return files with their hashes."""
    whats = ["what"] if any("what" in row for row in files) else []
    rows = [[row["name"], *(row[what] for what in whats), row["sha256"]] for row in files]
    columns = [text("file"), *map(text, whats), Column(name="SHA-256", kind="hash")]
    return table(f"{title} ({len(rows):,})", columns, rows, is_closed=True)
