"""Being told instead of asking: messages about jobs to a receiver of one's own."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Literal

from fastapi import APIRouter, Path, Response
from pydantic import BaseModel, ConfigDict, Field

from service.access.gate import CallerDep
from service.access.keys import Caller
from service.problems import Kind, ProblemError, declared
from service.services import Services, ServicesDep
from service.webhooks.outbox import EVENTS, MAX_ENDPOINTS, Endpoint, TooManyEndpointsError
from service.webhooks.sender import check_url

router = APIRouter(prefix="/webhooks", tags=["webhooks"])

WebhookId = Annotated[str, Path(max_length=64)]
Event = Literal["job.queued", "job.running", "job.succeeded", "job.failed", "job.cancelled", "job.expired"]


class WebhookRequest(BaseModel):
    """Where to send what."""

    model_config = ConfigDict(extra="forbid")

    url: str = Field(
        max_length=2000, description="https, with a public address.", examples=["https://example.com/hook"]
    )
    events: list[Event] = Field(
        default=["job.succeeded", "job.failed", "job.cancelled", "job.expired"],
        min_length=1,
        max_length=len(EVENTS),
    )


class Webhook(BaseModel):
    """A receiver."""

    id: str
    url: str
    events: list[str]
    created_at: datetime
    disabled: bool = Field(description="The receiver answered 410: it is told nothing more.")


class NewWebhook(Webhook):
    """A receiver, with the secret that is not shown again."""

    secret: str = Field(description="Checks signatures, as in Standard Webhooks.", examples=["whsec_..."])


class DeliveryView(BaseModel):
    """A message and what became of it."""

    id: str
    event: str
    created_at: datetime
    attempts: int
    state: Literal["delivered", "waiting", "given_up"]
    outcome: str = Field(description="The status or the trouble of the last attempt.")


class WebhookDetails(Webhook):
    """A receiver and its latest messages, newest first."""

    deliveries: list[DeliveryView]


class WebhookList(BaseModel):
    """All receivers."""

    webhooks: list[Webhook]


@router.post("", status_code=201, responses=declared(Kind.REQUEST_INVALID, Kind.WEBHOOK_URL, Kind.QUOTA))
def create_webhook(
    body: WebhookRequest, services: ServicesDep, caller: CallerDep, response: Response
) -> NewWebhook:
    """Have messages about your jobs sent to a receiver, signed as Standard Webhooks says. They are sent again
    for about a day until it answers 2xx, and may come twice or out of order."""
    wrong = check_url(body.url, private=services.settings.webhook_private)
    if wrong is not None:
        raise ProblemError(Kind.WEBHOOK_URL, wrong)
    try:
        made = services.outbox.create(caller.owner, body.url, sorted(set(body.events)))
    except TooManyEndpointsError:
        detail = f"{MAX_ENDPOINTS} webhooks are allowed."
        raise ProblemError(Kind.QUOTA, detail, headers={"Retry-After": "3600"}) from None
    response.headers["Location"] = f"/webhooks/{made.id}"
    return NewWebhook(**_view(made).model_dump(), secret=made.secret)


@router.get("")
def list_webhooks(services: ServicesDep, caller: CallerDep) -> WebhookList:
    """Your receivers."""
    return WebhookList(webhooks=[_view(endpoint) for endpoint in services.outbox.list(caller.sees)])


@router.get("/{webhook_id}", responses=declared(Kind.WEBHOOK_NOT_FOUND))
def get_webhook(webhook_id: WebhookId, services: ServicesDep, caller: CallerDep) -> WebhookDetails:
    """A receiver and what it was told lately."""
    endpoint = _found(services, webhook_id, caller)
    deliveries = [
        DeliveryView(
            id=message.id,
            event=message.event,
            created_at=_moment(message.created_at),
            attempts=message.attempts,
            state="waiting"
            if message.finished_at is None
            else "delivered"
            if message.delivered
            else "given_up",
            outcome=message.outcome,
        )
        for message in services.outbox.messages(webhook_id)
    ]
    return WebhookDetails(**_view(endpoint).model_dump(), deliveries=deliveries)


@router.post("/{webhook_id}/ping", status_code=202, responses=declared(Kind.WEBHOOK_NOT_FOUND))
def ping_webhook(webhook_id: WebhookId, services: ServicesDep, caller: CallerDep) -> None:
    """Send it a message of the type `ping`."""
    services.outbox.ping(_found(services, webhook_id, caller).id)


@router.delete("/{webhook_id}", status_code=204, responses=declared(Kind.WEBHOOK_NOT_FOUND))
def delete_webhook(webhook_id: WebhookId, services: ServicesDep, caller: CallerDep) -> None:
    """Tell it nothing more; what waits to be sent is forgotten."""
    services.outbox.delete(_found(services, webhook_id, caller).id)


def _found(services: Services, webhook_id: str, caller: Caller) -> Endpoint:
    endpoint = services.outbox.get(webhook_id, caller.sees)
    if endpoint is None:
        raise ProblemError(Kind.WEBHOOK_NOT_FOUND)
    return endpoint


def _view(endpoint: Endpoint) -> Webhook:
    return Webhook(
        id=endpoint.id,
        url=endpoint.url,
        events=endpoint.events,
        created_at=_moment(endpoint.created_at),
        disabled=endpoint.disabled_at is not None,
    )


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)
