"""What a browser gets: the page, and the documentation of the API. Nothing is loaded from elsewhere."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import FileResponse

WEB = Path(__file__).parents[1] / "web"

router = APIRouter(include_in_schema=False)


@router.get("/")
def get_page() -> FileResponse:
    """The page."""
    return FileResponse(WEB / "index.html", headers={"Cache-Control": "no-cache"})


@router.get("/docs")
def get_docs() -> FileResponse:
    """The documentation; docs.js fills it in from /openapi.json."""
    return FileResponse(WEB / "docs.html", headers={"Cache-Control": "no-cache"})
