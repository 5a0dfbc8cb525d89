"""Certificates: when they end, read from their files without a library for them, and the use of a folder of them."""

from __future__ import annotations

import re
import ssl
from datetime import UTC, datetime
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["context_of", "end_of", "ended"]

_PEM = re.compile(r"-----BEGIN CERTIFICATE-----.+?-----END CERTIFICATE-----", re.DOTALL)
_VALIDITY = re.compile(rb"(?:\x17\x0d|\x18\x0f)\d{12,14}Z(?:\x17\x0d|\x18\x0f)(\d{12,14})Z")
"""Two times, one after the other, as ASN.1 has them: UTCTime with two digits of the year, GeneralizedTime with four."""


def context_of(folder: Path | None) -> ssl.SSLContext:
    """Return the context of a client that trusts `ca.pem` of a folder and shows `cert.pem`, if that is there.

    None: it trusts the authorities of the system.

    Raises:
        OSError: a file cannot be used.
    """
    context = ssl.create_default_context(cafile=None if folder is None else str(folder / "ca.pem"))
    if folder is not None and (folder / "cert.pem").exists():
        context.load_cert_chain(folder / "cert.pem", folder / "key.pem")
    return context


def end_of(file: Path) -> datetime | None:
    """Return when the first of the certificates in a PEM file ends; None where there is none that can be read."""
    try:
        blocks = _PEM.findall(file.read_text(encoding="ascii"))
        found = [_VALIDITY.search(ssl.PEM_cert_to_DER_cert(block)) for block in blocks]
    except (OSError, ValueError):
        return None
    return min((_time(match[1].decode()) for match in found if match), default=None)


def ended(file: Path, end: datetime | None) -> str:
    """Return one line about a certificate that has ended; empty while it holds, or cannot be read."""
    if end is None or end > datetime.now(UTC):
        return ""
    return f"TLS: the certificate {file} ended on {end:%Y-%m-%d %H:%M} UTC"


def _time(digits: str) -> datetime:
    form = "%y%m%d%H%M%S" if len(digits) == len("YYMMDDhhmmss") else "%Y%m%d%H%M%S"
    return datetime.strptime(digits, form).replace(tzinfo=UTC)
