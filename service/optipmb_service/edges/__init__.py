"""Interfaces other than Zenoh, with their common parts: rights of callers, queues of readers, shared subscriptions."""
