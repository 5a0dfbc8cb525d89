"""What the service has on the network: its transport, inputs, viewers' subscriptions, and the client of its edges.

Zenoh itself is in `optipmb_client.zenoh`. What a member receives of streams is handed over on the thread of Zenoh that
brings it (`inputs`): the receiver puts the message into a backlog and does not wait.
"""
