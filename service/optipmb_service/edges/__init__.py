"""Ways to tracks other than Zenoh, and what they share: rights of callers, queues of readers, shared subscriptions."""
