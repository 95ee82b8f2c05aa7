"""``python -m service.openapi > openapi/openapi.json``: the API's document, as the app would serve it."""

from __future__ import annotations

import json

from service.app import create_app
from service.settings import Settings


def document() -> str:
    """The document as it is committed."""
    return json.dumps(create_app(Settings()).openapi(), indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    print(document(), end="")
