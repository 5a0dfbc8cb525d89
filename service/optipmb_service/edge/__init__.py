"""Common parts of the edges: rights of callers, queues of readers, and subscriptions that readers share."""
