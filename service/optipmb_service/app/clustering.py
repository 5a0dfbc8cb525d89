"""Who decides which streams an instance tracks, and where it keeps their state: by the setting `cluster`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from optipmb_service.cluster.coordinator import Coordinator
from optipmb_service.runtime.persistence import DAY_S

if TYPE_CHECKING:
    from optipmb_service.cluster.port import Ownership
    from optipmb_service.cluster.store import Store
    from optipmb_service.settings import Settings
    from optipmb_service.zenoh import Transport


def open_ownership(settings: Settings, transport: Transport) -> tuple[Ownership, Store | None]:
    """Return what decides on ownership, and the store that goes with it; None: a file in the folder of the state."""
    if not settings.cluster:
        return Coordinator(settings.instance, transport, settings.lease_s), None
    from optipmb_service.cluster.jetstream import JetStream  # noqa: PLC0415 - an extra
    from optipmb_service.cluster.member import FencedStore, Member  # noqa: PLC0415 - needed with it alone

    shared = JetStream(settings.cluster, settings.prefix, settings.keep_days * DAY_S)
    member = Member(settings.instance, shared, transport, settings.lease_s)
    return member, FencedStore(shared, member.fence)
