"""Zenoh, and nothing else: the one package of the client that imports it.

Conventions: payloads are bytes, keys are text, times are `time.monotonic_ns()`. Four rules avoid Zenoh's known traps:

- No callback of ours ever runs on a thread of the network. Each subscription has a daemon thread that always drains its
  channel into an `Inbox`, which drops its oldest entry when its reader is too slow. So a slow program delays nobody,
  closing never waits for a full channel, and a program that forgets to close still ends.
- Publishers of the same connection answer on the very thread that subscribes or asks, before the call returns, and with
  the lock of a cache held. So what they answer must find room: a subscription is drained from before it is declared,
  and the channel of a query has no bound.
- Closing goes from the outside in: subscriptions, publishers, session. After that nothing is delivered any more.
- Implicit shared memory is off: it loses messages without a word when a receiver stalls.
"""

from optipmb_client.zenoh.configuration import DEFAULT_ENDPOINT
from optipmb_client.zenoh.connection import Connection

__all__ = ["DEFAULT_ENDPOINT", "Connection"]
