"""The link to Zenoh: the one package that imports it, for nodes, commands and the service alike.

Conventions: payloads are bytes, keys are text, times are `time.monotonic_ns()`. Rules that avoid Zenoh's known traps:

- Received items go through a channel to a daemon thread, which always drains it. Zenoh's threads run no other code of
  ours, but for a receiver that is given to `Session.listen`. An `Inbox` behind drops its oldest entry when its reader
  is too slow. So a slow program delays no other, closing never waits for a full channel, and a program that forgets to
  close still ends. The channel is read, not the subscription: one that is being read cannot be undeclared.
- Publishers of the same session answer on the very thread that subscribes or asks, before the call returns, and with
  the lock of a cache held. So answers must find room: channels have no bound until they are read.
- References to declared objects are kept: Zenoh withdraws those without references. Publishers with heartbeats are
  withdrawn so and never undeclared (`Sender`).
- Closing goes from the outside in: subscriptions and queryables, publishers and tokens, session. After that nothing is
  delivered any more.
- Implicit shared memory is off: it loses messages without a word when a receiver stalls.
"""

from optipmb_client.zenoh.connection import DEFAULT_ENDPOINT, Connection

__all__ = ["DEFAULT_ENDPOINT", "Connection"]
