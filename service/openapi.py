"""``python -m service.openapi``: bring openapi/openapi.json, the API's document, up to date.

A change that would break programs written for the committed document is refused, unless ``--break`` says
that it is meant.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from service.app import create_app
from service.compatibility import breaking_changes
from service.settings import Settings

COMMITTED = Path(__file__).parents[1] / "openapi" / "openapi.json"


def document() -> str:
    """The document as it is committed."""
    return json.dumps(create_app(Settings()).openapi(), indent=2, ensure_ascii=False) + "\n"


def main() -> int:
    """Write the document; returns the exit code."""
    new = document()
    broken = (
        breaking_changes(json.loads(COMMITTED.read_text()), json.loads(new)) if COMMITTED.exists() else []
    )
    for change in broken:
        print(f"breaking: {change}", file=sys.stderr)
    if broken and "--break" not in sys.argv[1:]:
        print("openapi: not written; --break writes it all the same", file=sys.stderr)
        return 1
    COMMITTED.write_text(new)
    return 0


if __name__ == "__main__":
    sys.exit(main())
