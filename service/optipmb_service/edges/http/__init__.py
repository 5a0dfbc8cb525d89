"""Health, metrics and the live page over HTTP."""

from optipmb_service.edges.http.server import Server, application

__all__ = ["Server", "application"]
