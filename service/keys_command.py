"""``mass keys``: make, list and end API keys, straight in the job database of this machine's settings."""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from typing import Any

from service.access.keys import ApiKey, KeyStore, Scope
from service.jobs.store import create_store
from service.settings import Settings


def add_parser(commands: Any) -> None:
    """Add the command to ``mass``."""
    keys = commands.add_parser("keys", help="Make, list and end API keys.", description=__doc__)
    actions = keys.add_subparsers(title="actions", required=True, metavar="ACTION")
    create = actions.add_parser("create", help="print a new key; it is not shown again")
    create.add_argument("owner", help="whose jobs it sees")
    create.add_argument(
        "--scope", type=Scope, choices=list(Scope), action="append", metavar="read|write|admin"
    )
    create.add_argument("--days", type=float, help="how long it works (default: until revoked)")
    create.set_defaults(run=_create)
    actions.add_parser("list", help="list the keys, not their secrets").set_defaults(run=_list)
    revoke = actions.add_parser("revoke", help="end a key at once")
    revoke.add_argument("id", help="the key's second part, mass_<id>_...")
    revoke.set_defaults(run=_revoke)


def _create(options: argparse.Namespace) -> int:
    store = create_store(Settings())
    try:
        print(KeyStore(store.engine).create(options.owner, options.scope or [Scope.WRITE], options.days))
    except ValueError as error:
        print(f"mass: {error}", file=sys.stderr)
        return 2
    finally:
        store.close()
    return 0


def _list(_options: argparse.Namespace) -> int:
    store = create_store(Settings())
    for key in KeyStore(store.engine).list():
        print("  ".join((key.id, f"{key.owner:20}", ",".join(key.scopes), _state(key))))
    store.close()
    return 0


def _state(key: ApiKey) -> str:
    if key.revoked_at is not None:
        return f"revoked {_day(key.revoked_at)}"
    return "" if key.expires_at is None else f"until {_day(key.expires_at)}"


def _day(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).date().isoformat()


def _revoke(options: argparse.Namespace) -> int:
    store = create_store(Settings())
    done = KeyStore(store.engine).revoke(options.id)
    store.close()
    if not done:
        print(f"mass: there is no working key {options.id}", file=sys.stderr)
    return 0 if done else 1
