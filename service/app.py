"""The web application, made from settings."""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager
from importlib.metadata import version
from typing import Any

from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute
from fastapi.staticfiles import StaticFiles

from service import problems
from service.access.gate import Gate, asks_for_keys, is_public
from service.access.keys import KeyStore
from service.access.rates import RateLimiter
from service.bodies import BodyLimit
from service.guard import Guard
from service.jobs.housekeeping import purge_deleted, sweep_uploads
from service.jobs.schemas import UploadedJob
from service.metrics import own_port
from service.observing import Observer
from service.problems import Kind, ProblemBody, declared
from service.rendering import Loader, load_avatar
from service.routes import assets, jobs, links, page, progress, renders, submission, system, uploads, webhooks
from service.routes.progress import JobEventData
from service.services import Services, open_services
from service.settings import Settings
from service.webhooks.sender import Sender

_WEBHOOK_GRACE = 3.0
#: What every route but the public ones may answer.
ACCESS = (Kind.ACCESS_KEY, Kind.ACCESS_SCOPE, Kind.ACCESS_LINK)
#: What every route may answer: asked too often, or the database is away.
ANYWHERE = (Kind.RATE, Kind.NOT_READY)


def create_app(settings: Settings, loader: Loader = load_avatar) -> FastAPI:
    """Build the app. Nothing is opened before it starts; ``loader`` is what the render processes run."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        with open_services(settings, loader) as services:
            app.state.services = services
            app.state.signer = services.signer
            app.state.api_keys = KeyStore(services.store.engine)
            await run_in_threadpool(purge_deleted, services.store, services.storage)
            await run_in_threadpool(
                sweep_uploads, services.store, services.storage, settings.orphan_upload_seconds
            )
            with ExitStack() as stack:
                stack.enter_context(_webhooks(services))
                if settings.metrics_port is not None:
                    figures = own_port(services.metrics, settings.metrics_host, settings.metrics_port)
                    app.state.metrics_port = stack.enter_context(figures)
                yield

    app = FastAPI(
        title="MASS",
        version=version("mass-hand"),
        summary="A phone video of a hand in, a posable hand of 2-D Gaussian surfels out.",
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        generate_unique_id_function=_operation_id,
        separate_input_output_schemas=False,
    )
    problems.install(app)
    everywhere = declared(Kind.REQUEST_HOST, Kind.REQUEST_ORIGIN, Kind.INTERNAL)
    for router in (
        submission.router,
        jobs.router,
        progress.router,
        renders.router,
        assets.router,
        links.router,
        uploads.router,
        webhooks.router,
        system.router,
    ):
        app.include_router(router, responses=everywhere)
    app.include_router(page.router)
    app.mount("/web", StaticFiles(directory=page.WEB), name="web")
    app.add_middleware(BodyLimit)
    app.add_middleware(
        Gate,
        keyed=asks_for_keys(settings.auth, settings.host),
        addresses=_limiter(settings, settings.rate_address),
        owners=_limiter(settings, settings.rate_owner),
    )
    app.add_middleware(Guard, hosts=frozenset({settings.host, *settings.allowed_hosts}))
    app.add_middleware(Observer)
    app.openapi = lambda: _document(app)  # type: ignore[method-assign]
    return app


@contextmanager
def _webhooks(services: Services) -> Iterator[None]:
    """Messages are sent by a thread of each API process; which one sends a message is left to chance."""
    stopping = threading.Event()
    sender = Sender(services.outbox, private=services.settings.webhook_private)
    thread = threading.Thread(target=sender.run, args=(stopping,), name="webhooks", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        thread.join(_WEBHOOK_GRACE)


def _limiter(settings: Settings, rate: float) -> RateLimiter:
    return RateLimiter(rate, rate * settings.rate_burst_seconds)


def _operation_id(route: APIRoute) -> str:
    return route.name


def _add_answers(operation: dict[str, Any], *kinds: Kind) -> None:
    """Declare errors beside those that the route itself declares."""
    for kind in kinds:
        ((status, answer),) = declared(kind).items()
        known = operation["responses"].setdefault(str(status), answer)
        examples = known["content"][problems.MEDIA_TYPE]["examples"]
        if kind.code not in examples:
            known["description"] = "; ".join((known["description"], answer["description"]))
            examples.update(answer["content"][problems.MEDIA_TYPE]["examples"])


def _document(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document, in which every error is a problem."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
        schemas = document["components"]["schemas"]
        for model in (ProblemBody, UploadedJob, JobEventData):  # none of them is a route's declared type
            body = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas.update(body.pop("$defs", {}), **{model.__name__: body})
        for items in document["paths"].values():
            for operation in items.values():
                if "requestBody" in operation:
                    bodies = declared(Kind.REQUEST_MALFORMED, Kind.UPLOAD_STALLED, Kind.REQUEST_TOO_LARGE)
                    declares = operation["responses"]
                    declares |= {str(s): a for s, a in bodies.items() if str(s) not in declares}
        scheme = {"type": "http", "scheme": "bearer", "description": "A key of `mass keys create`."}
        document["components"]["securitySchemes"] = {"key": scheme}
        for path, method, operation in (
            (path, *item) for path, items in document["paths"].items() for item in items.items()
        ):
            if not is_public(path):
                operation["security"] = [{"key": []}, {}]
                _add_answers(operation, *ACCESS)
            _add_answers(operation, *ANYWHERE)
            if method not in ("get", "head", "options"):
                _add_answers(operation, Kind.STORAGE_FULL)
            # Added by the framework wherever there is a parameter; ours are declared by the routes.
            if "application/json" in operation["responses"].get("422", {}).get("content", {}):
                del operation["responses"]["422"]
        schemas.pop("HTTPValidationError", None)
        schemas.pop("ValidationError", None)
        app.openapi_schema = document
    return app.openapi_schema
