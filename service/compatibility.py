"""What in a new version of the API's document would break programs written for the old one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

Json = dict[str, Any]


def breaking_changes(old: Json, new: Json) -> list[str]:
    """One sentence for each change that a client of ``old`` would trip over; empty when there is none.

    Requests may ask for less and accept more, answers may say more: everything else is a break.
    """
    return [*_Comparison(old, new).differences()]


class _Comparison:
    def __init__(self, old: Json, new: Json) -> None:
        self._old, self._new = old, new

    def differences(self) -> Iterator[str]:
        for path, methods in self._old["paths"].items():
            for method, before in methods.items():
                name = f"{method.upper()} {path}"
                after = self._new["paths"].get(path, {}).get(method)
                if after is None:
                    yield f"{name} is gone"
                    continue
                yield from self._parameters(name, before, after)
                yield from self._body(name, before, after)
                yield from self._answers(name, before, after)

    def _parameters(self, name: str, before: Json, after: Json) -> Iterator[str]:
        known = {(p["in"], p["name"]): p for p in before.get("parameters", [])}
        now = {(p["in"], p["name"]): p for p in after.get("parameters", [])}
        for key, parameter in known.items():
            if key not in now:
                yield f"{name} no longer takes the {key[0]} parameter {key[1]}"
            else:
                where = f"{name}: parameter {key[1]}"
                yield from self._taken(where, parameter.get("schema", {}), now[key].get("schema", {}))
        for key, parameter in now.items():
            if parameter.get("required") and not known.get(key, {}).get("required"):
                yield f"{name} now requires the {key[0]} parameter {key[1]}"

    def _body(self, name: str, before: Json, after: Json) -> Iterator[str]:
        old, new = before.get("requestBody", {}), after.get("requestBody", {})
        for media, content in old.get("content", {}).items():
            if media not in new.get("content", {}):
                yield f"{name} no longer takes {media}"
            else:
                schema = new["content"][media].get("schema", {})
                yield from self._taken(f"{name}: body", content.get("schema", {}), schema)
        if new.get("required") and not old.get("required"):
            yield f"{name} now requires a body"

    def _answers(self, name: str, before: Json, after: Json) -> Iterator[str]:
        for status, answer in before["responses"].items():
            found = after["responses"].get(status)
            if found is None:
                if status < "400":
                    yield f"{name} no longer answers {status}"
                continue
            for media, content in answer.get("content", {}).items():
                if media not in found.get("content", {}):
                    yield f"{name} no longer answers {status} with {media}"
                else:
                    schema = found["content"][media].get("schema", {})
                    yield from self._given(f"{name} {status}", content.get("schema", {}), schema, ())

    def _taken(self, where: str, before: Json, after: Json) -> Iterator[str]:
        """What clients send: whatever was accepted must still be."""
        before, after = self._resolved(self._old, before), self._resolved(self._new, after)
        if gone := _values(before) - _values(after) if _values(after) else set():
            yield f"{where} no longer takes {', '.join(sorted(gone))}"
        if gone := _types(before) - _types(after) if _types(after) else set():
            yield f"{where} no longer takes a value of type {', '.join(sorted(gone))}"
        for limit, sign in (
            ("maximum", 1),
            ("maxLength", 1),
            ("maxItems", 1),
            ("minimum", -1),
            ("minItems", -1),
        ):
            if limit in after and (limit not in before or sign * after[limit] < sign * before[limit]):
                yield f"{where} has a narrower {limit}"
        properties = after.get("properties", {})
        for field, schema in before.get("properties", {}).items():
            if field not in properties:
                yield f"{where} no longer takes {field}"
            else:
                yield from self._taken(f"{where}.{field}", schema, properties[field])
        for field in {*after.get("required", [])} - {*before.get("required", [])}:
            yield f"{where} now requires {field}"

    def _given(self, where: str, before: Json, after: Json, seen: tuple[str, ...]) -> Iterator[str]:
        """What clients read: whatever was promised must still be there, and be nothing new."""
        name = before.get("$ref", "")
        if name in seen:
            return
        before, after = self._resolved(self._old, before), self._resolved(self._new, after)
        if _types(before) and (more := _types(after) - _types(before)):
            yield f"{where} may now be of type {', '.join(sorted(more))}"
        properties = after.get("properties", {})
        for field, schema in before.get("properties", {}).items():
            if field not in properties:
                yield f"{where} no longer says {field}"
            else:
                yield from self._given(f"{where}.{field}", schema, properties[field], (*seen, name))
        for field in {*before.get("required", [])} - {*after.get("required", [])}:
            yield f"{where} no longer promises {field}"
        if "items" in before and "items" in after:
            yield from self._given(f"{where}[]", before["items"], after["items"], (*seen, name))

    def _resolved(self, document: Json, schema: Json) -> Json:
        while "$ref" in schema:
            schema = document["components"]["schemas"].get(schema["$ref"].rpartition("/")[2], {})
        return schema


def _types(schema: Json) -> set[str]:
    found = {_type(option) for option in schema.get("anyOf", [schema])}
    return {kind for kind in found if kind}


def _type(schema: Json) -> str:
    return str(schema.get("type") or schema.get("$ref", "").rpartition("/")[2])


def _values(schema: Json) -> set[str]:
    options = schema.get("anyOf", [schema])
    listed = [value for option in options for value in option.get("enum", [])]
    return {str(value) for value in listed}
