"""W3C trace context of messages: the program's own, and its place in Zenoh attachments.

An attachment is text, one `name=value` on a line; lines of other names are left to others.
"""

import sys

__all__ = ["attached", "attachment_of", "current_traceparent"]

_NAME = b"traceparent="
_MOST_BYTES = 256  # of an attachment that is read: a `traceparent` has 55


def current_traceparent() -> str:
    """Return the `traceparent` of the active OpenTelemetry span; empty without one. Imports nothing."""
    current = getattr(sys.modules.get("opentelemetry.trace"), "get_current_span", None)
    span = None if current is None else current().get_span_context()
    if span is None or not span.is_valid:
        return ""
    return f"00-{span.trace_id:032x}-{span.span_id:016x}-{span.trace_flags:02x}"


def attachment_of(traceparent: str) -> bytes | None:
    """Return the attachment with a `traceparent`; None without one, or with one that is too long."""
    attachment = _NAME + traceparent.encode()
    return attachment if traceparent and len(attachment) <= _MOST_BYTES else None


def attached(attachment: bytes | None) -> str:
    """Return the `traceparent` of an attachment, unchecked; empty without one."""
    if attachment is None or len(attachment) > _MOST_BYTES:
        return ""
    lines = attachment.splitlines()
    return next((one[len(_NAME) :].decode("ascii", "replace") for one in lines if one.startswith(_NAME)), "")
