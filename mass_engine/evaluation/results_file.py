"""Results of a long benchmark: on disk after every part, and taken up again by ``--resume``."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mass_engine.errors import BadArgumentError

Row = dict[str, Any]


def write_text(path: Path, text: str) -> None:
    """Write a file in one step."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text)
    os.replace(partial, path)


def write_results(path: Path, command: str, settings: Mapping[str, Any], rows: list[Row]) -> None:
    """``rows`` as JSON, with what they were measured with."""
    data = {"command": command, "settings": dict(settings), "rows": rows}
    write_text(path, json.dumps(data, indent=2) + "\n")


def read_rows(path: Path, resume: bool, settings: Mapping[str, Any]) -> list[Row]:
    """The rows at ``path``; none without ``resume`` or file. Raises BadArgumentError ``bench.resume`` where
    the file is none, or was measured with other ``settings``."""
    if not resume or not path.is_file():
        return []
    try:
        data = json.loads(path.read_text())
        known, rows = data["settings"], list(data["rows"])
    except (ValueError, KeyError, TypeError) as error:
        raise BadArgumentError(
            "bench.resume",
            f"{path} holds no results ({error}).",
            "Give another --out, or leave out --resume.",
        ) from error
    other = sorted(name for name in {*known, *settings} if known.get(name) != settings.get(name))
    if other:
        raise BadArgumentError(
            "bench.resume",
            f"{path} was measured with other {', '.join(other)}.",
            "Use the same settings, or another --out.",
        )
    return rows
