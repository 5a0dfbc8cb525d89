"""The gRPC edge: a client of the network that speaks protobuf with streaming in both directions.

It keeps nothing of sessions: any number of gateways may stand behind a balancer, and a call may go on at another one.
Everything runs on one asyncio loop but the threads that read from the network, which decode, select and encode what
comes, once for all calls that want the same.
"""
