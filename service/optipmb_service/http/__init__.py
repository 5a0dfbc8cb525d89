"""Health, metrics and whatever else the service shows over HTTP."""

from optipmb_service.http.app import Source, application
from optipmb_service.http.hosts import KnownHosts
from optipmb_service.http.page import Watched, page
from optipmb_service.http.server import Server

__all__ = ["KnownHosts", "Server", "Source", "Watched", "application", "page"]
