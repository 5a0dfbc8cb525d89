"""ROS 2 at the edge: topics of an rmw_zenoh system become streams, and their tracks become topics.

It is a client of the same Zenoh network as the service, in a process of its own, and needs no ROS. `graph` knows how
rmw_zenoh names things, `bridge` converts messages, `node` declares and sends on the network.
"""
