"""Zenoh, and nothing else: the one package of the service that imports it.

Conventions: payloads are bytes, keys are text. Rules that avoid Zenoh's known traps:

- What a member receives of streams is handed over on the thread of Zenoh that brings it (`inputs`): what is called
  there puts the message into a backlog and does not wait. Queries, tokens, links and all other subscriptions have a
  channel each, which one thread always drains. It reads the channel, not the subscription: a subscription that is being
  read cannot be undeclared.
- The callback of a subscription is given with something to read (`handles.directly`): with a callback alone Zenoh does
  not withdraw what was declared for recovery beside it.
- References to publishers, tokens and subscriptions are kept: Zenoh withdraws what nobody refers to. Those with
  heartbeats are withdrawn so and never undeclared (`handles.Publisher`).
- Closing goes from the outside in: the alive token, subscriptions and queryables (their threads read on until the
  channels are closed and empty), publishers and owner tokens, the session.
"""

from optipmb_service.zenoh.connection import Router
from optipmb_service.zenoh.transport import Transport

__all__ = ["Router", "Transport"]
