"""Zenoh, and nothing else: the one package of the service that imports it.

Conventions: payloads are bytes, keys are text. Rules that avoid Zenoh's known traps:

- Nothing runs in Zenoh's callbacks. Every subscription is a FIFO channel that one thread always drains; what it calls
  must only put the message into a queue. The thread reads the channel's handler, not the subscription: a subscription
  that is being read cannot be undeclared.
- References to publishers, tokens and subscriptions are kept: Zenoh withdraws what nobody refers to. Those with
  heartbeats are withdrawn so and never undeclared (`handles.Publisher`).
- Closing goes from the outside in: the alive token, subscriptions and queryables (their threads read on until the
  channels are closed and empty), publishers and owner tokens, the session.
"""

from optipmb_service.zenoh.connection import Router
from optipmb_service.zenoh.transport import Transport

__all__ = ["Router", "Transport"]
