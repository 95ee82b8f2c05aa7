"""The web application, made from settings."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool
from fastapi.openapi.utils import get_openapi
from fastapi.responses import FileResponse
from fastapi.routing import APIRoute
from fastapi.staticfiles import StaticFiles

from service import problems
from service.guard import Guard
from service.jobs.housekeeping import purge_deleted, sweep_uploads
from service.problems import Kind, ProblemBody, declared
from service.rendering import Loader, load_avatar
from service.routes import assets, jobs, renders, submission, system
from service.services import open_services
from service.settings import Settings

_WEB = Path(__file__).parent / "web"


def create_app(settings: Settings, loader: Loader = load_avatar) -> FastAPI:
    """Build the app. Nothing is opened before it starts; ``loader`` is what the render processes run."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        with open_services(settings, loader) as services:
            app.state.services = services
            await run_in_threadpool(purge_deleted, services.store, services.storage)
            await run_in_threadpool(
                sweep_uploads, services.store, services.storage, settings.orphan_upload_seconds
            )
            yield

    app = FastAPI(
        title="MASS",
        version=version("mass-hand"),
        summary="A phone video of a hand in, a posable hand of 2-D Gaussian surfels out.",
        lifespan=lifespan,
        redoc_url=None,
        generate_unique_id_function=_operation_id,
        separate_input_output_schemas=False,
    )
    problems.install(app)
    everywhere = declared(Kind.REQUEST_HOST, Kind.REQUEST_ORIGIN, Kind.INTERNAL)
    for router in (submission.router, jobs.router, renders.router, assets.router, system.router):
        app.include_router(router, responses=everywhere)
    app.add_api_route("/", _page, include_in_schema=False)
    app.mount("/web", StaticFiles(directory=_WEB), name="web")
    app.add_middleware(Guard, hosts=frozenset({settings.host, *settings.allowed_hosts}))
    app.openapi = lambda: _document(app)  # type: ignore[method-assign]
    return app


def _page() -> FileResponse:
    return FileResponse(_WEB / "index.html", headers={"Cache-Control": "no-cache"})


def _operation_id(route: APIRoute) -> str:
    return route.name


def _document(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document, in which every error is a problem."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
        schemas = document["components"]["schemas"]
        body = ProblemBody.model_json_schema(ref_template="#/components/schemas/{model}")
        schemas.update(body.pop("$defs"), ProblemBody=body)
        for operation in (item for path in document["paths"].values() for item in path.values()):
            # Added by the framework wherever there is a parameter; ours are declared by the routes.
            if "application/json" in operation["responses"].get("422", {}).get("content", {}):
                del operation["responses"]["422"]
        schemas.pop("HTTPValidationError", None)
        schemas.pop("ValidationError", None)
        app.openapi_schema = document
    return app.openapi_schema
