"""Messages on the key of the status, of workers and re-identifications (JSON)."""

import json


def status_message(component: str, state: str, **more: object) -> bytes:
    """Return a message for the key of the status."""
    return json.dumps({"component": component, "state": state, **more}).encode()


def failure_status(component: str, message: str, name: str, sha256: str | None) -> bytes:
    """Return the announcement that a recording cannot be identified; ``sha256`` is ``None`` if it was not read."""
    return status_message(component, "failed", message=message, capture=name, sha256=sha256)
